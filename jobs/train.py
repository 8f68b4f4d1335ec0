"""Shards -> trained PVDA: `train.py RECIPE --shards DIR --out RUN [--weights FILE] [--workers N]`.

Writes RUN/last.pt (weights, config, and all that going on needs), RUN/metrics.jsonl (a row per epoch) and
RUN/tensorboard. Killed, it goes on from the last checkpoint when run again.
"""

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
import tyro
from ray.train import RunConfig, ScalingConfig, get_context
from ray.train.torch import TorchTrainer, get_device
from ray.util.queue import Queue
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from jobs.cli import run
from jobs.config_table import show_config
from jobs.recipes import RECIPES, Recipe
from jobs.training_loop import CHECKPOINT, Place, Run, open_stream, read_checkpoint, train_worker
from model.pvda import FeatureEncoder
from model.weights import load_backbone, read_state_dict
from pipeline import cluster, storage
from pipeline.progress import Meter, console, progress
from pipeline.records import InputError

if TYPE_CHECKING:
    RecipeChoice = Recipe
else:  # the command line's subcommands: a recipe by name, each of its settings open to be overridden
    RecipeChoice = tyro.extras.subcommand_type_from_defaults(
        {name: make() for name, make in RECIPES.items()},
        {name: (make.__doc__ or "").splitlines()[0] for name, make in RECIPES.items()},
        prefix_names=False,
    )


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What is trained on what, and by how many."""

    recipe: RecipeChoice
    shards: str
    "Folder or URI of the shards."
    out: str
    "Folder or URI of the run."
    weights: str | None = None
    "State dict of torchvision's ResNet (.pth or .safetensors) to start from."
    workers: int = 1
    "Ray Train workers; 0 trains in this process."
    gpus_per_worker: float | None = None
    "GPUs of a worker; by default one where the cluster has any."
    checkpoint_minutes: float = 5.0
    "Minutes between checkpoints, taken at the end of an epoch."

    def __post_init__(self) -> None:
        if self.workers < 0:
            raise InputError(f"--workers is {self.workers}, expected 0 (this process) or more")


def train(settings: Settings) -> str:
    """Train a recipe to its end and return the checkpoint's path; a finished run is left as it is.

    Raises InputError or CheckpointError on unusable input, before any worker starts.
    """
    this = Run(
        shards=storage.absolute(settings.shards), out=storage.absolute(settings.out), recipe=settings.recipe,
        weights=settings.weights and storage.absolute(settings.weights), checkpoint_minutes=settings.checkpoint_minutes,
    )  # fmt: skip
    path = storage.join(this.out, CHECKPOINT)
    held, epochs = read_checkpoint(this), settings.recipe.schedule.epochs
    done = 0 if held is None else held.epoch
    if done == epochs:
        console.print(f"{path} is complete: {epochs} epochs of recipe {settings.recipe.name}; nothing to do")
        return path
    steps = open_stream(this, Place(world=max(1, settings.workers))).steps
    if this.weights is not None and held is None:
        load_backbone(FeatureEncoder(this.recipe.network).backbone, read_state_dict(this.weights), this.weights)
    if held is not None:
        console.print(f"going on after epoch {done} of {epochs}")
    show_config(settings.recipe, shards=this.shards, out=this.out, weights=this.weights, workers=settings.workers)
    with progress((epochs - done) * steps, f"training {settings.recipe.name}", "steps") as meter:
        if settings.workers == 0:
            train_worker(this, Place(), lambda told: show(meter, told))
        else:
            train_on_ray(this, settings, meter)
    console.print(f"trained: {path}")
    return path


def train_on_ray(this: Run, settings: Settings, meter: Meter) -> None:
    """Train with Ray Train's workers; what rank 0 tells comes back through a queue."""
    cluster.connect()
    told = Queue(actor_options={"num_cpus": 0})
    gpus = settings.gpus_per_worker
    if gpus is None:
        gpus = 1.0 if cluster.gpus() >= settings.workers else 0.0
    cpus = max(1, cluster.cpus() // settings.workers)
    listener = threading.Thread(target=listen, args=(told, meter), daemon=True)
    listener.start()
    trainer = TorchTrainer(
        ray_worker,
        train_loop_config={"run": this, "told": told, "cpus": cpus},
        scaling_config=ScalingConfig(
            num_workers=settings.workers,
            use_gpu=gpus > 0,
            resources_per_worker={"CPU": cpus} | ({"GPU": gpus} if gpus else {}),
        ),
        # Ray Train's own records: our checkpoints are written by rank 0, so that they are the same with and without Ray.
        run_config=RunConfig(name="ray", storage_path=this.out),
    )
    try:
        trainer.fit()
    finally:
        told.put(None)
        listener.join()
        told.shutdown()


def ray_worker(config: dict[str, Any]) -> None:
    """A Ray Train worker: the same loop, with DDP around what is trained."""
    torch.set_num_threads(config["cpus"])  # Ray's OMP_NUM_THREADS would say the same; set on purpose
    context = get_context()
    told, rank = config["told"], context.get_world_rank()
    place = Place(
        rank=rank,
        world=context.get_world_size(),
        device=str(get_device()),
        distribute=distribute if context.get_world_size() > 1 else lambda module: module,
    )
    train_worker(config["run"], place, told.put if rank == 0 else lambda facts: None)


def distribute(module: nn.Module) -> nn.Module:
    # BatchNorm's running statistics stay each worker's own during training (rank 0's are kept): broadcasting them would
    # write into buffers between the two forward passes of one step.
    return DistributedDataParallel(module, broadcast_buffers=False)


def listen(told: Queue, meter: Meter) -> None:
    """Show what rank 0 tells until None comes."""
    while (facts := told.get()) is not None:
        show(meter, facts)


def show(meter: Meter, told: dict[str, Any]) -> None:
    facts = dict(told)
    meter.advance(facts.pop("steps"), **facts)


def refuse_unknown_recipe(arguments: Sequence[str]) -> None:
    """Name the recipes where the first word is none of them."""
    if arguments and not arguments[0].startswith("-") and arguments[0] not in RECIPES:
        raise InputError(f"unknown recipe {arguments[0]!r}, expected one of: {', '.join(RECIPES)}; see train.py --help")


def main(settings: Settings) -> None:
    """Train PVDA by a recipe; its settings can be overridden by flags of their names."""
    train(settings)


if __name__ == "__main__":
    run(main, refuse_unknown_recipe)
