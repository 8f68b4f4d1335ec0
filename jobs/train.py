"""Shards -> trained PVDA: `train.py RECIPE --shards DIR --out RUN [--weights FILE] [--workers N]`.

Writes RUN/last.pt (weights, config, and all that going on needs), RUN/metrics.jsonl (a row per
epoch) and RUN/tensorboard. Killed, it goes on from the last checkpoint when run again; where a Ray
worker dies, by itself.
"""

import jobs  # noqa: F401, I001  # before torch: Ctrl-C is heeded from here on

import threading
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from itertools import count
from typing import TYPE_CHECKING, Any

import torch
import tyro
from ray.exceptions import RayActorError
from ray.train import RunConfig as RayRunConfig
from ray.train import ScalingConfig, WorkerGroupError, get_context
from ray.train.torch import TorchTrainer, get_device
from ray.util.queue import Empty, Queue
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from jobs.command_line.cli import run
from jobs.training.config_table import print_config
from jobs.training.recipes import RECIPES, Recipe
from jobs.training.checkpoints import CHECKPOINT_FILE, find_checkpoint
from jobs.training.settings import RunOptions, RunConfig
from jobs.training.loop import (
    DamageCount,
    FoundCheckpoint,
    WorkerContext,
    open_stream,
    train_worker,
)
from model.errors import CheckpointError
from model.pvda import FeatureEncoder
from model.weights.load import load_backbone, read_state_dict
from pipeline.core import cluster, storage
from pipeline.core.lock import locks_output
from pipeline.core.progress import Meter, console, progress
from pipeline.core.errors import InputError, Incomplete
from pipeline.core.records import Split
from pipeline.shards.manifest import read_manifest, require_tars
from pipeline.shards.verify import require_intact

if TYPE_CHECKING:
    RecipeChoice = Recipe
else:  # the command line's subcommands: a recipe by name, each of its settings open to be overridden
    RecipeChoice = tyro.extras.subcommand_type_from_defaults(
        {name: make() for name, make in RECIPES.items()},
        {name: (make.__doc__ or "").splitlines()[0] for name, make in RECIPES.items()},
        prefix_names=False,
    )

QUEUE_POLL_S = 1.0
"For which the queue of what workers tell is asked before it is asked again."


@dataclass(frozen=True, kw_only=True)
class Settings(RunOptions):
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
    "GPUs of a worker; by default one where there are any."
    verify: bool = False
    "Look at every byte of the shards first; without it, that each tar is there and has its size."
    max_failures: int = 3
    """How often lost Ray workers are replaced and training goes on from the last checkpoint, before
    the job gives up."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.workers < 0:
            raise InputError(f"--workers is {self.workers}, expected 0 (this process) or more")

    @property
    def run(self) -> RunConfig:
        """The run as every worker is told of it."""
        conduct = {field.name: getattr(self, field.name) for field in fields(RunOptions)}
        return RunConfig(
            shards=storage.absolute(self.shards),
            out=storage.absolute(self.out),
            recipe=self.recipe,
            weights=self.weights and storage.absolute(self.weights),
            **conduct,
        )


@locks_output(lambda settings: settings.out)
def train(settings: Settings) -> str:
    """Train a recipe to its end and return the checkpoint's path; a finished run is left as it is.

    Raises InputError or CheckpointError on unusable input, before any worker starts.
    """
    this = settings.run
    path = storage.join(this.out, CHECKPOINT_FILE)
    found, epochs = find_checkpoint(this, console.print), settings.recipe.schedule.epochs
    done, step = (found[1].epoch, found[1].step) if found is not None else (0, 0)
    if done == epochs:
        console.print(
            f"{path} is complete: {epochs} epochs of recipe {settings.recipe.name}; nothing to do"
        )
        return path
    if settings.verify:
        require_intact(this.shards, None if settings.workers else 0)
    else:
        require_tars(this.shards, read_manifest(this.shards).of(Split.TRAIN))
    steps = open_stream(this, WorkerContext(world=max(1, settings.workers))).steps
    if this.weights is not None and found is None:
        load_backbone(
            FeatureEncoder(this.recipe.network).backbone,
            read_state_dict(this.weights),
            this.weights,
        )
    if found is not None:
        within = f" and {step} of {steps} steps" if step else ""
        console.print(f"going on after epoch {done} of {epochs}{within}")
    del found  # as large as the networks and their optimisers
    print_config(
        settings.recipe,
        shards=this.shards,
        out=this.out,
        weights=this.weights,
        workers=settings.workers,
    )
    with progress(
        (epochs - done) * steps - step, f"training {settings.recipe.name}", "steps"
    ) as meter:
        if settings.workers == 0:
            device = (
                "cuda" if torch.cuda.is_available() and settings.gpus_per_worker != 0 else "cpu"
            )
            train_worker(this, WorkerContext(device=device), lambda told: show_report(meter, told))
        else:
            train_on_ray(this, settings, meter)
    console.print(f"trained: {path}")
    return path


def train_on_ray(this: RunConfig, settings: Settings, meter: Meter) -> None:
    """Train with Ray Train's workers. When one dies, the group is started again and goes on from
    the last checkpoint.

    Not by Ray Train's own FailureConfig: that would try a run that has diverged again, and nobody
    would hear of it. Where Ray Train's controller dies, the job ends (RayActorError): the places
    that it had asked for may be lost until then.
    """
    cluster.connect()
    gpus = settings.gpus_per_worker
    if gpus is None:
        gpus = 1.0 if cluster.gpus() >= settings.workers else 0.0
    if this.recipe.sync_bn and settings.workers > 1 and not gpus:
        raise InputError(
            f"sync_bn is on and {settings.workers} workers have no GPUs, expected GPUs: torch synchronises BatchNorm on "
            "those alone; leave sync_bn off, or train with --workers 1"
        )
    cpus = max(1, cluster.cpus() // settings.workers)
    scaling = ScalingConfig(
        num_workers=settings.workers,
        use_gpu=gpus > 0,
        resources_per_worker={"CPU": cpus} | ({"GPU": gpus} if gpus else {}),
    )
    for failures in count(1):
        try:
            train_group(this, scaling, cpus, meter)
            break
        except WorkerGroupError as error:
            if failures > settings.max_failures:
                raise
            lost = ", ".join(
                sorted({type(failure).__name__ for failure in error.worker_failures.values()})
            )
            meter.note(
                f"lost a worker ({lost}); going on from the last checkpoint, {failures} of {settings.max_failures}"
            )


def train_group(this: RunConfig, scaling: ScalingConfig, cpus: int, meter: Meter) -> None:
    """Train with one group of workers; what they tell comes back through a queue.

    Raises what a worker gave as the reason why no other group would fare better, WorkerGroupError
    where one died.
    """
    told, refused = Queue(actor_options={"num_cpus": 0}), list[Exception]()
    listener = threading.Thread(target=listen, args=(told, meter, refused), daemon=True)
    listener.start()
    trainer = _Trainer(
        ray_worker,
        train_loop_config={"run": this, "told": told, "cpus": cpus},
        scaling_config=scaling,
        # Ray Train's own records: our checkpoints are written by rank 0, so that they are the same
        # with and without Ray.
        run_config=RayRunConfig(name="ray", storage_path=this.out),
    )
    try:
        trainer.fit()
    except (WorkerGroupError, RayActorError):
        stop_listener(told, listener)  # all has been heard
        if refused:
            raise refused[0] from None
        raise
    finally:
        stop_listener(told, listener)
        with suppress(RayActorError):
            told.shutdown()


def stop_listener(told: Queue, listener: threading.Thread) -> None:
    """Let the listener hear what is still in the queue, and end. Where the queue's actor was lost,
    it has ended already.
    """
    with suppress(RayActorError):
        told.put(None)
    listener.join()


class _Trainer(TorchTrainer):
    """Ray Train's, without its handler of Ctrl-C: that one ends the process with code 1 from within
    a call, and stays.
    """

    def _register_sigint_handler(self, controller: Any) -> None:
        pass


def ray_worker(config: dict[str, Any]) -> None:
    """A Ray Train worker: the same loop, with DDP around what is trained."""
    torch.set_num_threads(
        config["cpus"]
    )  # Ray's OMP_NUM_THREADS would say the same; set on purpose
    context, device = get_context(), get_device()
    told, rank, world = config["told"], context.get_world_rank(), context.get_world_size()
    if device.type == "cuda":
        torch.cuda.set_device(device)
    place = WorkerContext(rank=rank, world=world, device=str(device))
    if world > 1:
        place = replace(
            place, distribute=wrap_ddp, share=broadcast_checkpoint, gather=gather_damage
        )
    try:
        train_worker(config["run"], place, told.put if rank == 0 else lambda facts: None)
    except (Incomplete, InputError, CheckpointError) as error:
        told.put({"refused": error})
        raise


def wrap_ddp(module: nn.Module) -> nn.Module:
    # BatchNorm's running statistics stay each worker's own during training (rank 0's are kept):
    # broadcasting them would write into buffers between the two forward passes of one step.
    return DistributedDataParallel(module, broadcast_buffers=False)


def broadcast_checkpoint(found: FoundCheckpoint) -> FoundCheckpoint:
    """What rank 0 found."""
    held = [found]
    torch.distributed.broadcast_object_list(held, src=0)
    return held[0]


def gather_damage(damage: DamageCount) -> list[DamageCount]:
    """What each worker found, by rank."""
    held: list[DamageCount] = [(0, None)] * torch.distributed.get_world_size()
    torch.distributed.all_gather_object(held, damage)
    return held


def listen(told: Queue, meter: Meter, refused: list[Exception]) -> None:
    """Show what the workers tell until None comes, or the queue's actor is lost; keep why they
    cannot go on.
    """
    facts: dict[str, Any] | None = {}
    while facts is not None:
        try:
            # With an end: an actor that SIGTERM has told to go waits for what it was asked, and
            # answers nobody meanwhile.
            facts = told.get(timeout=QUEUE_POLL_S)
        except Empty:
            continue
        except RayActorError:
            return
        if facts and "refused" in facts:
            refused.append(facts["refused"])
        elif facts:
            show_report(meter, facts)


def show_report(meter: Meter, told: dict[str, Any]) -> None:
    facts = dict(told)
    if "note" in facts:
        meter.note(facts["note"])
    else:
        meter.advance(facts.pop("steps"), **facts)


def known_recipe(arguments: list[str]) -> list[str]:
    """The arguments as they are; where the first word is no recipe, an InputError that names them."""
    if arguments and not arguments[0].startswith("-") and arguments[0] not in RECIPES:
        raise InputError(
            f"unknown recipe {arguments[0]!r}, expected one of: {', '.join(RECIPES)}; see train.py --help"
        )
    return arguments


def main(settings: Settings) -> None:
    """Train PVDA by a recipe; its settings can be overridden by flags of their names."""
    train(settings)


if __name__ == "__main__":
    run(main, known_recipe)
