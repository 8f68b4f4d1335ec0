"""What a training step costs when its images are streamed, as a ratio to the same step on one batch
that is there already.

Prints one line per figure: the ratio (goal: at most 1.03), images per second, and the share of time
of each part.
"""

import argparse
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace

import numpy as np
import torch
from PIL import Image

from jobs.training.loop import BatchTensors, Worker, WorkerContext
from jobs.training.recipes import Recipe, paper, smoke
from jobs.training.settings import RunConfig
from model.losses import adversarial_terms, location_terms
from model.schedule import ScheduleState
from pipeline.core import storage
from pipeline.core.records import ImageRecord, Split, View
from pipeline.shards.manifest import MANIFEST, Manifest
from pipeline.shards.plan import ShardPlan
from pipeline.shards.writer import write_shard
from pipeline.sources.university1652 import University1652

NOW = ScheduleState(alpha=0.9, lr_scale=0.01)
ROUNDS = 3
"Streamed and resident steps take turns, so that whatever else the machine does meets both."


def made_shards(folder: str, side: int, images: int) -> str:
    """So many satellite images, and as many of a UAV, of `side` pixels: noise at several scales,
    which JPEG finds hard.
    """
    rng, written = np.random.default_rng(0), []
    for view in (View.DRONE, View.SATELLITE):
        records = []
        for number in range(images):
            image = np.zeros((side, side, 3))
            for cells in (4, 16, 64):
                coarse = Image.fromarray(rng.integers(0, 256, (cells, cells, 3), np.uint8))
                image += np.asarray(coarse.resize((side, side), Image.Resampling.BICUBIC)) / 3
            path = f"{folder}/{view}-{number:04d}.jpg"
            Image.fromarray(image.astype(np.uint8)).save(path, quality=90)
            records.append(
                ImageRecord(path=path, split=Split.TRAIN, view=view, location=f"{number:04d}")
            )
        plan = ShardPlan(
            name=f"train-{view}-000000", split=Split.TRAIN, view=view, records=tuple(records)
        )
        written.append(write_shard(plan, University1652(), folder, "").shard)
    classes = tuple(f"{number:04d}" for number in range(images))
    manifest = Manifest(shards=tuple(written), classes=classes, packing={}, rejected=0)
    storage.write_json(storage.join(folder, MANIFEST), asdict(manifest))
    return folder


def finished(device: torch.device) -> float:
    """The time, once the device has done what it was told."""
    if device.type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


def streamed(worker: Worker, epoch: int, steps: int) -> tuple[float, float]:
    """Seconds of a step that is fed by the stream, and of these the seconds that it waits for its
    batch.
    """
    batches = worker.batches(epoch)
    step(worker, next(batches))  # the stream starts
    waited, began = 0.0, finished(worker.training.device)
    for _ in range(steps):
        asked = time.perf_counter()
        batch = next(batches)
        waited += time.perf_counter() - asked
        step(worker, batch)
    return (finished(worker.training.device) - began) / steps, waited / steps


def resident(worker: Worker, batch: BatchTensors, steps: int) -> float:
    """Seconds of a step on a batch that is on the device."""
    began = finished(worker.training.device)
    for _ in range(steps):
        step(worker, batch)
    return (finished(worker.training.device) - began) / steps


def step(worker: Worker, batch: BatchTensors) -> None:
    images, labels, _ = batch
    worker.training.step(images[0], labels[0], images[1], labels[1], NOW)


def parts(worker: Worker, batch: BatchTensors, steps: int) -> dict[str, float]:
    """Seconds of each part of a step: the same computations, one after the other and each waited
    for.
    """
    training, spent = worker.training, defaultdict[str, float](float)

    @contextmanager
    def part(name: str) -> Iterator[None]:
        began = finished(training.device)
        yield
        spent[name] += (finished(training.device) - began) / steps

    def autocast() -> torch.autocast:
        return torch.autocast(training.device.type, torch.bfloat16, enabled=training.bfloat16)

    images, labels, _ = batch
    discriminator = training.discriminator
    assert discriminator is not None
    for _ in range(steps):
        with part("encoder"), autocast():
            maps1_BCHW, maps2_BCHW, logits1_BPL, logits2_BPL = training.learner(*images)
            located = location_terms(logits1_BPL, labels[0], logits2_BPL, labels[1]).sum()
            both_BCHW = torch.cat([maps1_BCHW, maps2_BCHW])
        with part("D step"):
            training.discriminate(both_BCHW.detach(), len(maps1_BCHW))
        with part("adversarial step"), autocast():
            discriminator.requires_grad_(False)
            verdict_B2 = discriminator(both_BCHW)
            discriminator.requires_grad_(True)
            loss = adversarial_terms(*verdict_B2.tensor_split([len(maps1_BCHW)])).sum()
            [pushed] = torch.autograd.grad(loss, both_BCHW, retain_graph=True)
        with part("encoder"):
            training.optimizers[0].zero_grad(set_to_none=True)
            torch.autograd.backward([located, both_BCHW], [None, NOW.alpha * pushed])
        with part("optimiser"):
            training.optimizers[0].step()
    return spent


def measure(name: str, recipe: Recipe, side: int, steps: int, device: str, compiled: bool) -> None:
    wanted = recipe.batch_size * (steps + 2)
    with tempfile.TemporaryDirectory() as folder:
        shards = made_shards(folder, side, wanted)
        run = RunConfig(shards=shards, out=folder, recipe=recipe, compile=compiled)
        worker = Worker(run, WorkerContext(device=device), lambda told: print(told["note"]))
        batch = next(iter(worker.batches(0)))
        resident(worker, batch, 3)  # warm
        rounds = [
            (*streamed(worker, epoch, steps), resident(worker, batch, steps))
            for epoch in range(ROUNDS)
        ]
        spent = parts(worker, batch, steps)
    fed, waited, there = (float(np.median(column)) for column in zip(*rounds, strict=True))
    ratios = ", ".join(f"{one / other:.3f}" for one, _, other in rounds)
    print(
        f"{name}: streamed step {1000 * fed:.1f} ms, {fed / there:.3f} x the resident step (rounds: {ratios})"
    )
    print(
        f"{name}: {2 * recipe.batch_size / fed:.1f} images/s, waits for data {100 * waited / fed:.1f} % of the step"
    )
    whole = sum(spent.values())
    print(
        f"{name}: "
        + ", ".join(f"{part} {100 * seconds / whole:.0f} %" for part, seconds in spent.items())
    )


CASES: dict[str, Callable[[], tuple[Recipe, int, int]]] = {
    "smoke, 16 + 16 images of 64 px": lambda: (smoke(), 128, 40),
    "ResNet-50, 4 + 4 images of 128 px": lambda: (
        replace(paper(), batch_size=4, network=replace(paper().network, image_size=128)),
        512,
        3,
    ),
}
"Recipe, side of the source's images, and steps of a round."
ON_CUDA: dict[str, Callable[[], tuple[Recipe, int, int]]] = {
    "paper, 8 + 8 images of 256 px": lambda: (paper(), 512, 100),
    "paper, 64 + 64 images of 256 px": lambda: (replace(paper(), batch_size=64), 512, 30),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--compile", action="store_true", help="compile the networks")
    compiled = parser.parse_args().compile
    device = "cuda" if torch.cuda.is_available() else "cpu"
    print(f"{device}, torch {torch.__version__}, {torch.get_num_threads()} threads")
    for name, case in (ON_CUDA if device == "cuda" else CASES).items():
        measure(name, *case(), device, compiled)


if __name__ == "__main__":
    main()
