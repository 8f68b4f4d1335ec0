"""The training loop: one epoch of steps.

In: a worker's state. Out: that state with other weights, and the epoch's row of metrics.jsonl. Each
step is `Training.step`; messages and checkpoints come between steps.
"""

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from jobs.training.checkpoints import RunRecorder
from jobs.training.metrics import DAMAGED
from jobs.training.state import TrainingState
from model.schedule import schedule_at
from pipeline.batches.training import Batch
from pipeline.core.prefetch import prefetch

SECONDS_BETWEEN_REPORTS = 1.0
PREFETCHED_BATCHES = 2
"Pairs of batches that wait for the step; decoding runs further ahead."
BatchTensors = tuple[list[Tensor], list[Tensor], tuple[str, ...]]
"Images and labels, of the drone's view and the satellite's, and the keys of damaged images."


def train_epoch(state: TrainingState, epoch: int, recorder: RunRecorder | None) -> dict[str, Any]:
    """Take the steps of one pass over the satellite view that are left; returns the epoch's row."""
    recipe, steps, first_damaged = state.run.recipe, state.stream.steps, None
    reported_at, reported_steps = time.monotonic(), state.metrics.steps
    for images, labels, damaged in load_batches(state, epoch):
        step = state.metrics.steps
        state.metrics.damaged += len(damaged)
        first_damaged = first_damaged or next(iter(damaged), None)
        schedule = schedule_at(recipe.schedule, epoch + step / steps)
        seed_dropout(recipe.seed, epoch, step, state.context.rank)
        state.metrics.add(state.training.step(images[0], labels[0], images[1], labels[1], schedule))
        if time.monotonic() - reported_at >= SECONDS_BETWEEN_REPORTS or step + 1 == steps:
            figures = {"epoch": f"{epoch + 1}/{recipe.schedule.epochs}", "alpha": schedule.alpha}
            report_steps(state, figures, state.metrics.steps - reported_steps)
            reported_at, reported_steps = time.monotonic(), state.metrics.steps
        if recorder is not None and step + 1 < steps:
            recorder.after_step(state.checkpoint)
    return {
        "epoch": epoch + 1, "step": (epoch + 1) * steps, "alpha": schedule.alpha,
        "learning_rate_scale": schedule.lr_scale, "learning_rates": state.training.learning_rates,
        **state.means(), "images_per_second": state.images_per_second,
        "seconds": state.metrics.seconds, DAMAGED: count_damaged(state, epoch, first_damaged),
    }  # fmt: skip


def seed_dropout(seed: int, epoch: int, step: int, rank: int) -> None:
    """Make dropout a function of seed, epoch, step and rank, however often a run was resumed."""
    sequence = np.random.SeedSequence([seed, epoch, step, rank])
    torch.manual_seed(int(sequence.generate_state(1)[0]))


def report_steps(state: TrainingState, figures: dict[str, Any], steps: int) -> None:
    rates = "/".join(f"{rate:.2g}" for rate in state.training.learning_rates.values())
    totals = {name: mean for name, mean in state.means().items() if "/" not in name}
    speed = {"rates": rates, "images/s": state.images_per_second}
    state.report({"steps": steps} | figures | speed | totals)


def count_damaged(state: TrainingState, epoch: int, first: str | None) -> int:
    """Images of all workers that could not be decoded in this epoch; reported if there are any."""
    counts = state.context.gather((state.metrics.damaged, first))
    total = sum(count for count, _ in counts)
    if total:
        key = next((key for _, key in counts if key is not None), None)
        named = f"; the first of them is {key}" if key else ""  # none: all came before a restart
        state.report(
            {
                "note": f"epoch {epoch + 1}: {total} images could not be decoded, and others of "
                f"their batches replaced them{named}; pack {state.run.shards} again to remove them"
            }
        )
    return total


def load_batches(state: TrainingState, epoch: int) -> Iterator[BatchTensors]:
    """Images and labels of both views on the device, prefetched; keys of damaged images."""
    device = state.training.device

    def tensors(pair: tuple[Batch, Batch]) -> BatchTensors:
        images = [torch.from_numpy(batch.images_B3HW) for batch in pair]
        labels = [torch.from_numpy(batch.location_B) for batch in pair]
        if device.type == "cuda":  # from pinned memory the copy runs beside the computation
            images = [tensor.pin_memory() for tensor in images]
            labels = [tensor.pin_memory() for tensor in labels]
        return images, labels, pair[0].damaged + pair[1].damaged

    pairs = state.stream.epoch(epoch, state.metrics.steps)
    for images, labels, damaged in prefetch(map(tensors, pairs), PREFETCHED_BATCHES):
        yield (
            [tensor.to(device, non_blocking=True) for tensor in images],
            [tensor.to(device, non_blocking=True) for tensor in labels],
            damaged,
        )
