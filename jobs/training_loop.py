"""What one training worker does, wherever it runs: stream batches, take steps, write checkpoints and curves.

In: shards and a recipe. Out: RUN/last.pt, RUN/metrics.jsonl, RUN/tensorboard, written by rank 0.
"""

import json
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.tensorboard import SummaryWriter

from jobs.recipes import Recipe
from model.checkpoint import Checkpoint, dumps, loads
from model.schedule import phase
from model.training import Training
from model.weights import load_backbone, read_state_dict
from pipeline import storage
from pipeline.records import InputError
from pipeline.stream import Reading, TrainingStream

CHECKPOINT, CURVES = "last.pt", "metrics.jsonl"
Report = Callable[[dict[str, Any]], None]
"Takes what a worker tells while it runs: `steps` done since the last time, and facts to show."


@dataclass(frozen=True, kw_only=True)
class Run:
    """One training run: what is trained on what, and where it is kept."""

    shards: str
    "Folder or URI of the shards, as every worker can open it."
    out: str
    "Folder or URI of the run, likewise."
    recipe: Recipe
    weights: str | None = None
    "State dict of torchvision's ResNet to start from."
    checkpoint_minutes: float = 5.0
    "A checkpoint is written at the end of the epoch in which so many minutes have passed, and of the last one."


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where in a run's group of workers this one stands, and what it computes on."""

    rank: int = 0
    world: int = 1
    device: str = "cpu"
    distribute: Callable[[nn.Module], nn.Module] = lambda module: module


def train_worker(run: Run, place: Place, report: Report) -> None:
    """Train to the end of the recipe's schedule, from the run's checkpoint where there is one."""
    recipe = run.recipe
    stream = open_stream(run, place)
    training, history = start(run, place, len(stream.classes))
    epochs = recipe.schedule.epochs
    if place.rank:
        for epoch in range(len(history), epochs):
            train_epoch(training, stream, recipe, epoch, place, report)
        return
    saved = time.monotonic()
    with closing(Curves(run.out, len(history))) as curves:
        for epoch in range(len(history), epochs):
            history.append(train_epoch(training, stream, recipe, epoch, place, report))
            curves.write(history)
            if epoch + 1 == epochs or time.monotonic() - saved >= 60 * run.checkpoint_minutes:
                storage.write_bytes(
                    storage.join(run.out, CHECKPOINT), dumps(checkpoint(run, training, stream, history))
                )
                saved = time.monotonic()


def open_stream(run: Run, place: Place) -> TrainingStream:
    """The training images as this worker sees them.

    Raises InputError when the shards cannot be trained on.
    """
    recipe = run.recipe
    reading = Reading(
        batch_size=recipe.batch_size,
        image_size=recipe.network.image_size,
        augmentation=recipe.augmentation,
        seed=recipe.seed,
        threads=max(1, torch.get_num_threads()),
    )
    return TrainingStream(run.shards, reading, place.rank, place.world)


def start(run: Run, place: Place, locations: int) -> tuple[Training, list[dict[str, Any]]]:
    """Networks and optimisers as the run's checkpoint has them, else fresh, and the rows of the epochs that are over."""
    training = fresh(run, place, locations)
    held = read_checkpoint(run)
    if held is None:
        return training, []
    training.load_state(held.state)
    return training, held.history


def fresh(run: Run, place: Place, locations: int) -> Training:
    """Networks and optimisers before the first step, the same on every worker."""
    recipe = run.recipe
    torch.manual_seed(recipe.seed)
    training = Training(
        recipe.network, recipe.optimisation, locations,
        adversary=recipe.adversary, device=place.device, distribute=place.distribute,
    )  # fmt: skip
    if run.weights is not None:
        load_backbone(training.learner.encoder.backbone, read_state_dict(run.weights), run.weights)
    return training


def read_checkpoint(run: Run) -> Checkpoint | None:
    """The run's checkpoint, if it has one.

    Raises InputError when it is of another recipe, CheckpointError when it is damaged.
    """
    path = storage.join(run.out, CHECKPOINT)
    if not storage.exists(path):
        return None
    held = loads(storage.read_bytes(path), path)
    # Through JSON, as the checkpoint has it: tuples become lists.
    recipe = json.loads(json.dumps(asdict(run.recipe)))
    changed = sorted(name for name in recipe | held.recipe if held.recipe.get(name) != recipe.get(name))
    if changed:
        raise InputError(
            f"{path} was trained by recipe {held.recipe.get('name')} with another {', '.join(changed)}; choose another --out, "
            "or the same recipe and settings to go on with it"
        )
    return held


def checkpoint(run: Run, training: Training, stream: TrainingStream, history: list[dict[str, Any]]) -> Checkpoint:
    return Checkpoint(
        network=run.recipe.network, recipe=asdict(run.recipe), locations=list(stream.classes),
        epoch=len(history), history=history, state=training.state(),
    )  # fmt: skip


def untrained(run: Run) -> bytes:
    """The checkpoint of a run before its first step, however far it is: what training starts from, to compare with."""
    stream = open_stream(run, Place())
    return dumps(checkpoint(run, fresh(run, Place(), len(stream.classes)), stream, []))


def train_epoch(
    training: Training, stream: TrainingStream, recipe: Recipe, epoch: int, place: Place, report: Report
) -> dict[str, Any]:
    """One pass over the satellite view; returns the epoch's row of metrics.jsonl."""
    # Dropout's random numbers are a function of seed, epoch and rank, on every device, however often a run was resumed.
    torch.manual_seed(int(np.random.SeedSequence([recipe.seed, epoch, place.rank]).generate_state(1)[0]))
    began = told = time.monotonic()
    sums: dict[str, Tensor] = defaultdict(lambda: torch.zeros((), device=training.device))
    untold = 0
    now = phase(recipe.schedule, epoch)
    for step, (drone, satellite) in enumerate(stream.epoch(epoch)):
        now = phase(recipe.schedule, epoch + step / stream.steps)
        images = [torch.from_numpy(batch.images_B3HW).to(training.device) for batch in (drone, satellite)]
        labels = [torch.from_numpy(batch.location_B).to(training.device) for batch in (drone, satellite)]
        for name, value in training.step(images[0], labels[0], images[1], labels[1], now).items():
            sums[name] += value
        untold += 1
        if time.monotonic() - told >= 1 or step + 1 == stream.steps:
            means = {name: float(value) / (step + 1) for name, value in sums.items()}
            seconds = time.monotonic() - began
            speed = (step + 1) * 2 * recipe.batch_size * place.world / seconds
            rates = "/".join(f"{rate:.2g}" for rate in training.rates.values())
            facts = {
                "epoch": f"{epoch + 1}/{recipe.schedule.epochs}",
                "alpha": now.alpha,
                "rates": rates,
                "images/s": speed,
            }
            report({"steps": untold} | facts | means)
            told, untold = time.monotonic(), 0
    return {
        "epoch": epoch + 1, "step": (epoch + 1) * stream.steps, "alpha": now.alpha,
        "learning_rate_scale": now.rate_scale, "learning_rates": training.rates,
        **{name: float(value) / stream.steps for name, value in sums.items()},
        "images_per_second": speed, "seconds": time.monotonic() - began,
    }  # fmt: skip


class Curves:
    """The run's curves for people: RUN/metrics.jsonl whole after each epoch, and TensorBoard where RUN is on a disk."""

    def __init__(self, out: str, epochs: int) -> None:
        self._path = storage.join(out, CURVES)
        self._board: SummaryWriter | None = None
        if storage.is_local(out):
            folder = storage.locate(storage.join(out, "tensorboard"))[1]
            # What a killed run wrote after its last checkpoint is dropped, as it is from metrics.jsonl.
            self._board = SummaryWriter(folder, purge_step=epochs + 1)

    def write(self, history: list[dict[str, Any]]) -> None:
        lines = "".join(json.dumps(row) + "\n" for row in history)
        storage.write_bytes(self._path, lines.encode())
        if self._board is not None:
            row = history[-1]
            flat = {name: value for name, value in row.items() if isinstance(value, float)}
            flat |= {f"learning_rate/{group}": rate for group, rate in row["learning_rates"].items()}
            for name, value in flat.items():
                self._board.add_scalar(name, value, row["epoch"])
            self._board.flush()

    def close(self) -> None:
        if self._board is not None:
            self._board.close()
