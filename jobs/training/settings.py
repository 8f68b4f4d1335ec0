"""The settings of a training run: what is trained on what, where it is kept, and how it is carried
out. Imports nothing heavy, so that the command line is parsed at once."""

from dataclasses import dataclass

from jobs.training.recipes import Recipe
from pipeline.core.errors import InputError


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """How a run is carried out. Nothing of it changes what is trained, so a run may go on with
    another.
    """

    checkpoint_epochs: int = 1
    "A checkpoint is written at the end of every so many epochs, and of the last one."
    checkpoint_minutes: float = 10.0
    "And whenever so many minutes have passed since the last one, within an epoch too."
    keep: int = 2
    "Checkpoints that are kept: last.pt and the ones before it, which stand in where it is damaged."
    probe_epochs: int = 10
    "Epochs between two looks at the view gap and at the places held out; 0 never looks."
    compile: bool = False
    """Whether the networks are compiled by torch; where that fails, training says so and goes on
    without."""

    def __post_init__(self) -> None:
        for name in ("checkpoint_epochs", "keep"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}, expected at least 1")
        for name in ("checkpoint_minutes", "probe_epochs"):
            if getattr(self, name) < 0:
                raise InputError(f"{name} is {getattr(self, name)}, expected 0 or more")


@dataclass(frozen=True, kw_only=True)
class RunConfig(RunOptions):
    """One training run: what is trained on what, and where it is kept."""

    shards: str
    "Folder or URI of the shards, as every worker can open it."
    out: str
    "Folder or URI of the run, likewise."
    recipe: Recipe
    weights: str | None = None
    "State dict of torchvision's ResNet to start from."
