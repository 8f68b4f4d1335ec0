"""What one training worker does, wherever it runs: stream batches, take steps, tell, and leave
checkpoints and curves.

In: shards and a recipe. Out: the run's folder, written by rank 0.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from jobs.training.checkpoints import CHECKPOINT_FILE, RunRecorder, find_checkpoint
from jobs.training.metrics import DAMAGED, MetricAccumulator, NotFinite
from jobs.training.probes import probe
from jobs.training.settings import RunConfig
from model.checkpoint import Checkpoint, dumps
from model.errors import CheckpointError
from model.schedule import schedule_at
from model.training import Training
from model.weights.load import load_backbone, read_state_dict
from pipeline.batches.training import Batch, StreamConfig, TrainingStream
from pipeline.core import storage
from pipeline.core.errors import Incomplete
from pipeline.core.prefetch import prefetch

SECONDS_BETWEEN_REPORTS = 1.0
PREFETCHED_BATCHES = 2
"Pairs of batches that wait for the step; decoding runs further ahead."
BatchTensors = tuple[list[Tensor], list[Tensor], tuple[str, ...]]
Report = Callable[[dict[str, Any]], None]
"""Takes what a worker tells while it runs: `steps` done since the last time and facts to show, or a
`note`."""
FoundCheckpoint = tuple[str, Checkpoint] | None
DamageCount = tuple[int, str | None]
"How many images could not be decoded, and the key of the first."


@dataclass(frozen=True, kw_only=True)
class WorkerContext:
    """Where in a run's group of workers this one stands, and what it computes on."""

    rank: int = 0
    world: int = 1
    device: str = "cpu"
    distribute: Callable[[nn.Module], nn.Module] = lambda module: module
    share: Callable[[FoundCheckpoint], FoundCheckpoint] = lambda found: found
    """Gives every worker what rank 0 has: all go on from one checkpoint, whatever each of them sees
    of the storage."""
    gather: Callable[[DamageCount], list[DamageCount]] = lambda damage: [damage]
    "Gives every worker what each of them has, by rank."


def train_worker(run: RunConfig, place: WorkerContext, report: Report) -> None:
    """Train to the end of the recipe's schedule, from the run's checkpoint where there is one.

    Raises Unfinished when training diverges; the last checkpoint is then one from before.
    """
    worker, epochs = Worker(run, place, report), run.recipe.schedule.epochs
    with ExitStack() as stack:
        keeper = (
            stack.enter_context(closing(RunRecorder(run, worker.found)))
            if place.rank == 0
            else None
        )
        for epoch in range(len(worker.history), epochs):
            row = worker.epoch(epoch, keeper)
            if keeper is None:
                worker.over(row)
                continue
            if run.probe_epochs and ((epoch + 1) % run.probe_epochs == 0 or epoch + 1 == epochs):
                row |= probe(worker.training.learner.encoder, worker.stream)
            worker.over(row)
            keeper.after_epoch(worker.checkpoint, worker.history)


class Worker:
    """One training worker and where in the run it is."""

    def __init__(self, run: RunConfig, place: WorkerContext, report: Report) -> None:
        self.run, self.place, self._report = run, place, report
        self.stream = open_stream(run, place)
        self.training = build_training(run, place, len(self.stream.classes))
        if self.training.compile_error is not None:
            report(
                {"note": f"not compiled, training goes on without: {self.training.compile_error}"}
            )
        self.found = place.share(find_checkpoint(run) if place.rank == 0 else None)
        self.history: list[dict[str, Any]] = []
        "The rows of the epochs that are over."
        self.metrics = MetricAccumulator()
        if self.found is not None:
            name, held = self.found
            try:
                self.training.load_state_dict(held.state)
            # torch's, over another's state
            except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
                raise CheckpointError(
                    f"{name} of {run.out} is not of this training ({type(error).__name__}); expected one that jobs/train.py "
                    "wrote on these shards; choose another --out, or take it away to go on from the one before"
                ) from error
            self.history, self.metrics = (
                list(held.history),
                MetricAccumulator(held.step, held.metric_sums),
            )
            if place.rank > 0:  # the checkpoint's count is rank 0's
                self.metrics.damaged = 0

    def epoch(self, epoch: int, keeper: RunRecorder | None) -> dict[str, Any]:
        """The steps of one pass over the satellite view that are still to do; returns the epoch's
        row of metrics.jsonl.
        """
        recipe, steps, first = self.run.recipe, self.stream.steps, None
        told_at, told_steps = time.monotonic(), self.metrics.steps
        for images, labels, damaged in self.batches(epoch):
            step = self.metrics.steps
            self.metrics.damaged += len(damaged)
            first = first or next(iter(damaged), None)
            now = schedule_at(recipe.schedule, epoch + step / steps)
            # Dropout's random numbers are a function of seed, epoch, step and rank, however often a
            # run was resumed.
            seeds = np.random.SeedSequence([recipe.seed, epoch, step, self.place.rank])
            torch.manual_seed(int(seeds.generate_state(1)[0]))
            self.metrics.add(self.training.step(images[0], labels[0], images[1], labels[1], now))
            if time.monotonic() - told_at >= SECONDS_BETWEEN_REPORTS or step + 1 == steps:
                facts = {"epoch": f"{epoch + 1}/{recipe.schedule.epochs}", "alpha": now.alpha}
                self._tell(facts, self.metrics.steps - told_steps)
                told_at, told_steps = time.monotonic(), self.metrics.steps
            if keeper is not None and step + 1 < steps:
                keeper.after_step(self.checkpoint)
        damage = self._damage(epoch, first)
        return {
            "epoch": epoch + 1, "step": (epoch + 1) * steps, "alpha": now.alpha,
            "learning_rate_scale": now.lr_scale, "learning_rates": self.training.rates,
            **self.means(), "images_per_second": self.speed, "seconds": self.metrics.seconds,
            DAMAGED: damage,
        }  # fmt: skip

    def _damage(self, epoch: int, first: str | None) -> int:
        """Images of all workers that could not be decoded in this epoch; said once where there are
        any.
        """
        told = self.place.gather((self.metrics.damaged, first))
        count, first = (
            sum(count for count, _ in told),
            next((key for _, key in told if key is not None), None),
        )
        if count:
            which = (
                f"; the first of them is {first}" if first else ""
            )  # none where all came before a kill
            self._report(
                {
                    "note": f"epoch {epoch + 1}: {count} images could not be decoded, and others of their batches took their "
                    f"places{which}; pack {self.run.shards} again to be rid of them"
                }
            )
        return count

    def over(self, row: dict[str, Any]) -> None:
        """The epoch of this row is over."""
        self.history.append(row)
        self.metrics = MetricAccumulator()

    def checkpoint(self) -> Checkpoint:
        """All that going on from here needs. Raises Unfinished where it would hold the ruins of a
        diverged run.
        """
        self.means()
        made = make_checkpoint(self.run, self.training, self.stream, self.history)
        return replace(made, step=self.metrics.steps, metric_sums=self.metrics.state_dict())

    def means(self) -> dict[str, float]:
        """Means of the epoch's measures so far; raises Unfinished where one is not finite."""
        try:
            return self.metrics.means()
        except NotFinite as error:
            last = storage.join(self.run.out, CHECKPOINT_FILE)
            raise Incomplete(
                f"training diverged in epoch {len(self.history) + 1}, by step {self.metrics.steps} of {self.stream.steps}: "
                f"{error}, expected a finite number; {last}, where there is one, is from before; train anew into another --out "
                "with lower learning rates or --precision float32"
            ) from None

    @property
    def speed(self) -> float:
        """Images per second of all workers, over the epoch so far."""
        return (
            self.metrics.steps
            * 2
            * self.run.recipe.batch_size
            * self.place.world
            / self.metrics.seconds
        )

    def _tell(self, facts: dict[str, Any], steps: int) -> None:
        rates = "/".join(f"{rate:.2g}" for rate in self.training.rates.values())
        whole = {name: mean for name, mean in self.means().items() if "/" not in name}
        self._report({"steps": steps} | facts | {"rates": rates, "images/s": self.speed} | whole)

    def batches(self, epoch: int) -> Iterator[BatchTensors]:
        """Images and labels of both views on the device, ready before the step asks for them; keys
        of damaged images.
        """
        device = self.training.device

        def tensors(pair: tuple[Batch, Batch]) -> BatchTensors:
            images = [torch.from_numpy(batch.images_B3HW) for batch in pair]
            labels = [torch.from_numpy(batch.location_B) for batch in pair]
            if device.type == "cuda":  # from pinned memory the copy runs beside the computation
                images = [tensor.pin_memory() for tensor in images]
                labels = [tensor.pin_memory() for tensor in labels]
            return images, labels, pair[0].damaged + pair[1].damaged

        for images, labels, damaged in prefetch(
            map(tensors, self.stream.epoch(epoch, self.metrics.steps)), PREFETCHED_BATCHES
        ):
            images, labels = (
                [tensor.to(device, non_blocking=True) for tensor in both]
                for both in (images, labels)
            )
            yield images, labels, damaged


def open_stream(run: RunConfig, place: WorkerContext) -> TrainingStream:
    """The training images as this worker sees them.

    Raises InputError when the shards cannot be trained on.
    """
    recipe = run.recipe
    reading = StreamConfig(
        batch_size=recipe.batch_size,
        image_size=recipe.network.image_size,
        resizer=recipe.resizer,
        augmentation=recipe.augmentation,
        seed=recipe.seed,
        threads=max(1, torch.get_num_threads()),
        hold_out=recipe.hold_out,
    )
    return TrainingStream(run.shards, reading, place.rank, place.world)


def build_training(run: RunConfig, place: WorkerContext, locations: int) -> Training:
    """Networks and optimisers before the first step, the same on every worker."""
    recipe = run.recipe
    torch.manual_seed(recipe.seed)
    training = Training(
        recipe.network,
        recipe.optimization,
        locations,
        adversary=recipe.adversary,
        device=place.device,
        distribute=place.distribute,
        precision=recipe.precision,
        sync_bn=recipe.sync_bn and place.world > 1,
        joint_bn=recipe.joint_bn,
        compile_for=recipe.batch_size if run.compile else None,
    )
    if run.weights is not None:
        load_backbone(training.learner.encoder.backbone, read_state_dict(run.weights), run.weights)
    return training


def make_checkpoint(
    run: RunConfig, training: Training, stream: TrainingStream, history: list[dict[str, Any]]
) -> Checkpoint:
    """The run at the end of its last epoch in `history`."""
    return Checkpoint(
        network=run.recipe.network, recipe=asdict(run.recipe), locations=list(stream.classes),
        epoch=len(history), history=history, state=training.state(),
    )  # fmt: skip


def initial_checkpoint(run: RunConfig) -> bytes:
    """The checkpoint of a run before its first step, however far it is: what training starts from,
    to compare with.
    """
    stream = open_stream(run, WorkerContext())
    return dumps(
        make_checkpoint(run, build_training(run, WorkerContext(), len(stream.classes)), stream, [])
    )
