"""Packing against `tar cf` of the same files: one line per figure, each a ratio to tar in the same
run.

In: made JPEGs in a temporary folder (or `--scratch`). Reading is from the page cache in both,
writing ends with fsync in both.

    python benchmarks/shards.py [--images 20000]
"""

import argparse
import os
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.core import cluster
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.sources.university1652 import University1652

PER_LOCATION = 50


def make_images(root: Path, images: int, side: int) -> int:
    """That many JPEGs in University-1652's layout, no two alike; returns their bytes in all."""
    rng, total = np.random.default_rng(0), 0
    for number in range(images):
        path = (
            root
            / f"train/drone/{number // PER_LOCATION:04d}/image-{number % PER_LOCATION:02d}.jpeg"
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        if number < 200:
            coarse = Image.fromarray(rng.integers(0, 256, (side // 8, side // 8, 3), np.uint8))
            coarse.resize((side, side), Image.Resampling.BICUBIC).save(path, quality=92)
        else:  # a picture made before, told apart by its comment: drawing all would take an hour
            data = (
                root
                / f"train/drone/{number % 200 // PER_LOCATION:04d}/image-{number % PER_LOCATION:02d}.jpeg"
            ).read_bytes()
            path.write_bytes(data[:2] + b"\xff\xfe\x00\x0a" + f"{number:08d}".encode() + data[2:])
        total += path.stat().st_size
    return total


def by_tar(root: Path, out: Path) -> None:
    out.mkdir()
    subprocess.run(["tar", "cf", str(out / "all.tar"), "-C", str(root), "."], check=True)
    with (out / "all.tar").open("rb") as stream:
        os.fsync(stream.fileno())


def by_us(root: Path, out: Path, workers: int) -> None:
    pack(University1652(), PackingSettings(root=str(root), out=str(out), workers=workers))


def seconds(work: Callable[[Path], None], scratch: Path, repeats: int) -> float:
    """Median of `repeats`; each writes a new folder, which is taken away afterwards."""
    taken = []
    for _ in range(repeats):
        out = scratch / "out"
        began = time.perf_counter()
        work(out)
        taken.append(time.perf_counter() - began)
        shutil.rmtree(out)
    return statistics.median(taken)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--images", type=int, default=20000)
    parser.add_argument("--side", type=int, default=512, help="pixels; University-1652 has 512")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--scratch", help="folder for the files; a temporary one by default")
    given = parser.parse_args()
    cluster.connect()
    with tempfile.TemporaryDirectory(dir=given.scratch) as folder:
        root, scratch = Path(folder) / "imagery", Path(folder)
        size = make_images(root, given.images, given.side)
        by_tar(root, scratch / "warm")
        shutil.rmtree(scratch / "warm")
        tar = seconds(lambda out: by_tar(root, out), scratch, given.repeats)
        print(
            f"shards: {given.images} images, {size / 1e6:.0f} MB; tar cf takes {tar:.2f} s, {size / tar / 1e6:.0f} MB/s"
        )
        for workers, name in ((0, "this process"), (1, "one task"), (2, "two tasks")):
            taken = seconds(lambda out: by_us(root, out, workers), scratch, given.repeats)  # noqa: B023
            print(
                f"shards: packing by {name} takes {taken / tar:.2f} x tar's time, {taken:.2f} s, "
                f"{given.images / taken:.0f} images/s, {size / taken / 1e6:.0f} MB/s"
            )


if __name__ == "__main__":
    main()
