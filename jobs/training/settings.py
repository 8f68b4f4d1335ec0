"""The settings of a training run: what is trained on what, where, and how it is carried out.

Imports nothing heavy, so that the command line is parsed at once.
"""

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import tyro

from jobs.command_line.config import Choice
from jobs.training.recipes import RECIPES
from jobs.training.recipes.recipe import Recipe
from model.backbones import HUB_PREFIX
from pipeline.core import storage
from pipeline.core.errors import require

RUN_CONFIG_FILE = "config.yaml"
"In the run's folder: the settings that it was trained with, which `train --like RUN` repeats."
RECIPE = Choice(
    name="recipe",
    names=tuple(RECIPES),
    name_of=lambda recipe: recipe.name if recipe.name in RECIPES else "paper",
)
"""The command line's first word. A recipe of another name is written as all of its settings, so any
word may stand before them."""

if TYPE_CHECKING:
    RecipeChoice = Recipe
else:  # the command line's subcommands: a recipe by name, each of its settings a flag
    RecipeChoice = tyro.extras.subcommand_type_from_defaults(
        {name: make() for name, make in RECIPES.items()},
        {name: (make.__doc__ or "").splitlines()[0] for name, make in RECIPES.items()},
        prefix_names=False,
    )


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """How a run is carried out. None of it changes what is trained, so a run may resume with other
    options.
    """

    checkpoint_epochs: int = 1
    "Write a checkpoint at the end of every so many epochs, and of the last one."
    checkpoint_minutes: float = 10.0
    "And whenever so many minutes have passed since the last one, within an epoch too."
    keep: int = 2
    "Checkpoints to keep: last.pt and the ones before it, which replace it where it is damaged."
    probe_epochs: int = 10
    "Epochs between two measurements of the view gap and of held-out locations; 0: never."
    compile: bool = False
    "Compile the networks with torch; where that fails, training says so and continues uncompiled."

    def __post_init__(self) -> None:
        for name in ("checkpoint_epochs", "keep"):
            require(getattr(self, name) >= 1, name, getattr(self, name), "at least 1")
        for name in ("checkpoint_minutes", "probe_epochs"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "0 or more")


@dataclass(frozen=True, kw_only=True)
class RunConfig(RunOptions):
    """One training run: what is trained on what, and where it is stored."""

    shards: str
    "Folder or URI of the shards, as every worker can open it."
    out: str
    "Folder or URI of the run, likewise."
    recipe: Recipe
    weights: str | None = None
    "Weights to start from, in place of the recipe's `start`: a file, a folder or hf:OWNER/NAME."


@dataclass(frozen=True, kw_only=True)
class TrainSettings(RunOptions):
    """What is trained on what, and by how many workers."""

    recipe: RecipeChoice
    shards: str
    "Folder or URI of the shards."
    out: str
    "Folder or URI of the run."
    weights: str | None = None
    """File to start from (.pt, .pth, .safetensors), in place of the recipe's `start`: a checkpoint
    of ours, or public weights of the backbone. For backbones of transformers a folder of
    `save_pretrained`, or hf:OWNER/NAME from the Hugging Face hub."""
    workers: int = 1
    "Ray Train workers; 0 trains in this process."
    gpus_per_worker: float | None = None
    "GPUs of a worker; by default one where there are any."
    verify: bool = False
    "Check every byte of the shards first; without it, that each tar exists and has its size."
    max_failures: int = 3
    """How often lost Ray workers are replaced and training resumes from the last checkpoint, before
    the job gives up."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.workers >= 0, "workers", self.workers, "0 (this process) or more")

    @property
    def run(self) -> RunConfig:
        """The run as every worker gets it, with absolute paths."""
        options = {field.name: getattr(self, field.name) for field in fields(RunOptions)}
        return RunConfig(
            shards=storage.absolute(self.shards),
            out=storage.absolute(self.out),
            recipe=self.recipe,
            weights=self.weights and _absolute_weights(self.weights),
            **options,
        )


def _absolute_weights(weights: str) -> str:
    return weights if weights.startswith(HUB_PREFIX) else storage.absolute(weights)
