"""What a training worker holds: the data's stream, the networks, and how far training is.

In: a run, and the worker's context. Out: a `TrainingState`, resumed from the run's newest
checkpoint where there is one, that makes the next checkpoint.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol, TypeVar

import torch
from torch import nn

from jobs.training.checkpoints import CHECKPOINT_FILE, FoundCheckpoint, find_checkpoint
from jobs.training.metrics import MetricAccumulator, NotFinite
from jobs.training.settings import RunConfig
from model.checkpoint import Checkpoint
from model.errors import CheckpointError
from model.training import Training
from model.weights.start import load_start
from pipeline.batches.pseudo_labels import with_pseudo_labels
from pipeline.batches.settings import StreamConfig
from pipeline.batches.training import TrainingStream
from pipeline.core import storage
from pipeline.core.errors import Incomplete
from pipeline.shards.shard_set import open_shards

PSEUDO_LABELS = "pseudo_labels"
"Entry of a checkpoint's state."
Report = Callable[[dict[str, Any]], None]
"""Takes a worker's messages: `steps` taken since the last one with figures to show, or a `note`."""
DamageCount = tuple[int, str | None]
"How many images could not be decoded, and the key of the first."
Shared = TypeVar("Shared")


class Broadcast(Protocol):
    """Gives every worker what rank 0 has."""

    def __call__(self, value: Shared) -> Shared: ...


def keep(value: Shared) -> Shared:
    """The broadcast of a worker without others."""
    return value


@dataclass(frozen=True, kw_only=True)
class WorkerContext:
    """A worker's rank among the run's workers, its device, and how it reaches the others."""

    rank: int = 0
    world_size: int = 1
    device: str = "cpu"
    wrap_ddp: Callable[[nn.Module], nn.Module] = lambda module: module
    broadcast: Broadcast = keep
    """Gives every worker rank 0's checkpoint and pseudo-labels, so that all train from one state
    whatever each of them sees of the storage."""
    gather: Callable[[DamageCount], list[DamageCount]] = lambda damage: [damage]
    "Gives every worker the counts of all, by rank."
    after_epoch: Callable[[dict[str, Any]], None] = lambda row: None
    "Takes the epoch's row; Ray Train shows it on its dashboard."


class TrainingState:
    """One worker's stream, networks and progress."""

    def __init__(self, run: RunConfig, context: WorkerContext, report: Report) -> None:
        self.run, self.context, self.report = run, context, report
        self.stream = open_stream(run, context)
        self.training = build_training(run, context, len(self.stream.classes))
        if self.training.compile_error is not None:
            reason = self.training.compile_error
            report({"note": f"not compiled, training continues uncompiled: {reason}"})
        self.pseudo_labels: dict[str, Any] | None = None
        "Those of the round that training is in, as a checkpoint stores them: `rounds.py`."
        found = find_checkpoint(run) if context.rank == 0 else None
        self.found: FoundCheckpoint = context.broadcast(found)
        self.history: list[dict[str, Any]] = []
        "The rows of the completed epochs."
        self.metrics = MetricAccumulator()
        "Of the epoch that is not complete."
        if self.found is not None:
            self._resume(*self.found)

    def _resume(self, name: str, checkpoint: Checkpoint) -> None:
        try:
            self.training.load_state_dict(checkpoint.state)
        # torch's, over another's state
        except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            raise CheckpointError(
                f"{name} of {self.run.out} is not of this training ({type(error).__name__}); "
                "expected one that jobs/train.py wrote on these shards; choose another --out, or "
                "take it away to resume from the one before"
            ) from error
        self.pseudo_labels = checkpoint.state.get(PSEUDO_LABELS)
        self.history = list(checkpoint.history)
        self.metrics = MetricAccumulator(checkpoint.step, checkpoint.metric_sums)
        if self.context.rank > 0:  # the checkpoint's count is rank 0's
            self.metrics.damaged = 0

    def end_epoch(self, row: dict[str, Any]) -> None:
        """Record the row of a completed epoch and begin the next one's metrics."""
        self.history.append(row)
        self.metrics = MetricAccumulator()

    def checkpoint(self) -> Checkpoint:
        """All that resuming from here needs. Raises Incomplete where training has diverged."""
        self.means()
        made = make_checkpoint(self.run, self.training, self.stream, self.history)
        state = made.state
        if self.pseudo_labels is not None:
            state = state | {PSEUDO_LABELS: self.pseudo_labels}
        sums = self.metrics.state_dict()
        return replace(made, state=state, step=self.metrics.steps, metric_sums=sums)

    def means(self) -> dict[str, float]:
        """Means of the epoch's metrics so far. Raises Incomplete where one is not finite."""
        try:
            return self.metrics.means()
        except NotFinite as error:
            last = storage.join(self.run.out, CHECKPOINT_FILE)
            raise Incomplete(
                f"training diverged in epoch {len(self.history) + 1}, by step {self.metrics.steps} "
                f"of {self.stream.steps}: {error}, expected a finite number; {last}, where there "
                "is one, is from before; train anew into another --out with lower learning rates "
                "or --precision float32"
            ) from None

    @property
    def images_per_second(self) -> float:
        """Of all workers, over the epoch so far."""
        per_step = 2 * self.run.recipe.batch_size * self.context.world_size
        return self.metrics.steps * per_step / self.metrics.seconds


def open_stream(
    run: RunConfig, context: WorkerContext, satellite_of: Mapping[str, str] | None = None
) -> TrainingStream:
    """The training images as this worker sees them; where the recipe makes pseudo-labels, with
    these, and without them to be counted only.

    Raises InputError when the shards cannot be trained on.
    """
    recipe = run.recipe
    config = StreamConfig(
        batch_size=recipe.batch_size,
        image_size=recipe.network.image_size,
        resizer=recipe.resizer,
        perspective=recipe.perspective,
        augmentation=recipe.augmentation,
        seed=recipe.seed,
        threads=max(1, torch.get_num_threads()),
        hold_out=recipe.hold_out,
        sampler=recipe.sampler,
        pair_repeats=recipe.pair_repeats,
    )
    shards = open_shards(run.shards)
    if recipe.pseudo_neighbours:
        shards = with_pseudo_labels(shards, satellite_of)
    return TrainingStream(shards, config, context.rank, context.world_size)


def build_training(run: RunConfig, context: WorkerContext, locations: int) -> Training:
    """Networks and optimizers before the first step, the same on every worker."""
    recipe = run.recipe
    torch.manual_seed(recipe.seed)
    training = Training(
        recipe.network,
        recipe.optimization,
        locations,
        losses=recipe.losses,
        adversary=recipe.adversary,
        device=context.device,
        wrap_ddp=context.wrap_ddp,
        precision=recipe.precision,
        sync_bn=recipe.sync_bn and context.world_size > 1,
        joint_bn=recipe.joint_bn,
        compile_for=recipe.batch_size if run.compile else None,
    )
    load_start(training.model.encoder, recipe.network.backbone, recipe.start, run.weights)
    return training


def make_checkpoint(
    run: RunConfig, training: Training, stream: TrainingStream, history: list[dict[str, Any]]
) -> Checkpoint:
    """The run at the end of the last epoch in `history`."""
    return Checkpoint(
        network=run.recipe.network, recipe=asdict(run.recipe), locations=list(stream.classes),
        epoch=len(history), history=history, state=training.state_dict(),
    )  # fmt: skip
