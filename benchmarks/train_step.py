"""A training step on streamed images, as a ratio to the same step on one batch in memory.

Prints one line per figure: the ratio (goal: at most 1.03), images per second, and the share of time
of each part of a step.
"""

import argparse
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from synthetic import jpegs

from jobs.training.loop import BatchTensors, load_batches
from jobs.training.recipes.builtin import builtin
from jobs.training.recipes.pvda import paper, smoke
from jobs.training.recipes.recipe import Recipe
from jobs.training.settings import RunConfig
from jobs.training.state import TrainingState, WorkerContext
from model.losses.pvda import adversarial_terms
from model.schedule import ScheduleState
from pipeline.core import json_files, storage
from pipeline.core.records import ImageRecord, Split, View
from pipeline.shards.manifest import MANIFEST, Manifest
from pipeline.shards.plan import ShardPlan
from pipeline.shards.writer import write_shard
from pipeline.sources.university1652 import University1652

NOW = ScheduleState(alpha=0.9, lr_scale=0.01)
ROUNDS = 3
"Streamed and resident steps alternate, so that other work on the machine slows both."


@dataclass(frozen=True, kw_only=True)
class StepSeconds:
    """Seconds of a step; medians over the rounds."""

    streamed: float
    waiting: float
    "Part of `streamed` spent waiting for the batch."
    resident: float
    ratios: tuple[float, ...]
    "Streamed over resident, by round."
    parts: dict[str, float]


def write_shards(folder: str, side: int, images: int, distinct: int | None = None) -> str:
    """Write a set of so many UAV images and as many satellite images of `side` pixels, `distinct`
    of which differ.
    """
    written = []
    for seed, view in enumerate((View.DRONE, View.SATELLITE)):
        records = []
        data = jpegs(min(images, distinct or images), side, side, seed)
        for number in range(images):
            path = Path(folder) / f"{view}-{number:04d}.jpg"
            path.write_bytes(data[number % len(data)])
            records.append(
                ImageRecord(path=str(path), split=Split.TRAIN, view=view, location=f"{number:04d}")
            )
        plan = ShardPlan(
            name=f"train-{view}-000000", split=Split.TRAIN, view=view, records=tuple(records)
        )
        written.append(write_shard(plan, University1652(), folder, "").shard)
    classes = tuple(f"{number:04d}" for number in range(images))
    manifest = Manifest(shards=tuple(written), classes=classes, packing={}, rejected=0)
    json_files.write_checksummed(storage.join(folder, MANIFEST), asdict(manifest))
    return folder


def synchronised_time(device: torch.device) -> float:
    """The time at which the device has finished its queued work."""
    if device.type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


def streamed(worker: TrainingState, epoch: int, steps: int) -> tuple[float, float]:
    """(Seconds of a step on streamed batches, the part of them spent waiting for the batch)."""
    batches = load_batches(worker, epoch)
    step(worker, next(batches))  # starts the stream
    waited, begin = 0.0, synchronised_time(worker.training.device)
    for _ in range(steps):
        request = time.perf_counter()
        batch = next(batches)
        waited += time.perf_counter() - request
        step(worker, batch)
    return (synchronised_time(worker.training.device) - begin) / steps, waited / steps


def resident(worker: TrainingState, batch: BatchTensors, steps: int) -> float:
    """Seconds of a step on a batch that is already on the device."""
    begin = synchronised_time(worker.training.device)
    for _ in range(steps):
        step(worker, batch)
    return (synchronised_time(worker.training.device) - begin) / steps


def step(worker: TrainingState, batch: BatchTensors) -> None:
    images, labels, _ = batch
    worker.training.step(images[0], labels[0], images[1], labels[1], NOW)


def parts(worker: TrainingState, batch: BatchTensors, steps: int) -> dict[str, float]:
    """Seconds of each part of a step, run one after the other with a wait after each."""
    training, spent = worker.training, defaultdict[str, float](float)

    @contextmanager
    def part(name: str) -> Iterator[None]:
        begin = synchronised_time(training.device)
        yield
        spent[name] += (synchronised_time(training.device) - begin) / steps

    def autocast() -> torch.autocast:
        return torch.autocast(training.device.type, torch.bfloat16, enabled=training.bfloat16)

    images, labels, _ = batch
    discriminator = training.discriminator
    for _ in range(steps):
        with part("encoder"):
            with autocast():
                drone, satellite = training.model(*images)
            fitted = training.objective(drone, labels[0], satellite, labels[1])[0]
        losses, gradients = [fitted], [torch.ones_like(fitted)]
        if discriminator is not None:
            both_BCHW = torch.cat([drone.maps_BCHW, satellite.maps_BCHW])
            count = len(drone.maps_BCHW)
            with part("D step"):
                training.discriminate(both_BCHW.detach(), count)
            with part("adversarial step"), autocast():
                discriminator.requires_grad_(False)
                verdict_B2 = discriminator(both_BCHW)
                discriminator.requires_grad_(True)
                loss = adversarial_terms(*verdict_B2.tensor_split([count])).sum()
                [gradient_BCHW] = torch.autograd.grad(loss, both_BCHW, retain_graph=True)
            losses, gradients = [*losses, both_BCHW], [*gradients, NOW.alpha * gradient_BCHW]
        with part("encoder"):
            training.optimizers[0].zero_grad(set_to_none=True)
            torch.autograd.backward(losses, gradients)
        with part("optimiser"):
            training.optimizers[0].step()
    return spent


def time_steps(
    recipe: Recipe,
    side: int,
    steps: int,
    rounds: int,
    device: str,
    compiled: bool,
    distinct: int | None = None,
) -> StepSeconds:
    """Streamed and resident steps of a recipe, alternating; sources of `side` pixels."""
    images = recipe.batch_size * (steps + 2)
    with tempfile.TemporaryDirectory() as folder:
        shards = write_shards(folder, side, images, distinct)
        run = RunConfig(shards=shards, out=folder, recipe=recipe, compile=compiled)
        worker = TrainingState(run, WorkerContext(device=device), lambda row: print(row["note"]))
        batch = next(iter(load_batches(worker, 0)))
        resident(worker, batch, 3)  # warm
        seconds = [
            (*streamed(worker, epoch, steps), resident(worker, batch, steps))
            for epoch in range(rounds)
        ]
        spent = parts(worker, batch, steps)
    fed, waited, in_memory = (float(np.median(column)) for column in zip(*seconds, strict=True))
    return StepSeconds(
        streamed=fed,
        waiting=waited,
        resident=in_memory,
        ratios=tuple(one / other for one, _, other in seconds),
        parts=spent,
    )


def measure(
    name: str, recipe: Recipe, side: int, steps: int, rounds: int, device: str, compiled: bool
) -> None:
    """Print the figures of one case."""
    found = time_steps(recipe, side, steps, rounds, device, compiled)
    ratios = ", ".join(f"{ratio:.3f}" for ratio in found.ratios)
    print(
        f"{name}: streamed step {1000 * found.streamed:.1f} ms, "
        f"{found.streamed / found.resident:.3f} x the resident step (rounds: {ratios})"
    )
    print(
        f"{name}: {2 * recipe.batch_size / found.streamed:.1f} images/s, waits for data "
        f"{100 * found.waiting / found.streamed:.1f} % of the step"
    )
    total = sum(found.parts.values())
    shares = [f"{part} {100 * seconds / total:.0f} %" for part, seconds in found.parts.items()]
    print(f"{name}: " + ", ".join(shares))


CASES: dict[str, Callable[[], tuple[Recipe, int, int]]] = {
    "smoke, 16 + 16 images of 64 px": lambda: (smoke(), 128, 40),
    "builtin, 8 + 8 images of 128 px": lambda: (
        replace(builtin(), batch_size=8, start="random"),
        256,
        3,
    ),
    "ResNet-50, 4 + 4 images of 128 px": lambda: (
        replace(paper(), batch_size=4, network=replace(paper().network, image_size=128)),
        512,
        3,
    ),
}
"Case -> recipe, side of the source images, and steps of a round."
ON_CUDA: dict[str, Callable[[], tuple[Recipe, int, int]]] = {
    "paper, 8 + 8 images of 256 px": lambda: (paper(), 512, 100),
    "builtin, 64 + 64 images of 256 px": lambda: (
        replace(
            builtin(),
            batch_size=64,
            start="random",
            network=replace(builtin().network, image_size=256),
        ),
        512,
        30,
    ),
    "paper, 64 + 64 images of 256 px": lambda: (replace(paper(), batch_size=64), 512, 30),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--compile", action="store_true", help="compile the networks")
    add("--cases", nargs="+", help="first words of the cases to run; all by default")
    add("--steps", type=int, help="steps of a round; the case's own by default")
    add("--rounds", type=int, default=ROUNDS, help="alternating rounds")
    args = parser.parse_args()
    device = "cuda" if torch.cuda.is_available() else "cpu"
    print(f"{device}, torch {torch.__version__}, {torch.get_num_threads()} threads")
    for name, case in (ON_CUDA if device == "cuda" else CASES).items():
        if not args.cases or name.startswith(tuple(args.cases)):
            recipe, side, steps = case()
            measure(name, recipe, side, args.steps or steps, args.rounds, device, args.compile)


if __name__ == "__main__":
    main()
