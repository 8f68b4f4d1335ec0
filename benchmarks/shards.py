"""Packing speed as a ratio to `tar cf` of the same files in the same run, one line per figure.

The input is synthetic JPEGs in a temporary folder (or `--scratch`). Both read from the page cache
and end with fsync.

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
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.core import cluster
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.sources.university1652 import University1652

PER_LOCATION = 50
DRAWN = 200
"Images drawn; the others repeat them and differ by a JPEG comment: drawing all takes an hour."


def image_path(root: Path, number: int) -> Path:
    location, view = divmod(number, PER_LOCATION)
    return root / f"train/drone/{location:04d}/image-{view:02d}.jpeg"


def make_images(root: Path, images: int, side: int) -> int:
    """Write so many distinct JPEGs in University-1652's layout; their total size in bytes."""
    rng, total = np.random.default_rng(0), 0
    for number in range(images):
        path = image_path(root, number)
        path.parent.mkdir(parents=True, exist_ok=True)
        if number < DRAWN:
            coarse = Image.fromarray(rng.integers(0, 256, (side // 8, side // 8, 3), np.uint8))
            coarse.resize((side, side), Image.Resampling.BICUBIC).save(path, quality=92)
        else:
            data = image_path(root, number % DRAWN).read_bytes()
            path.write_bytes(data[:2] + b"\xff\xfe\x00\x0a" + f"{number:08d}".encode() + data[2:])
        total += path.stat().st_size
    return total


def run_tar(root: Path, out: Path) -> None:
    out.mkdir()
    subprocess.run(["tar", "cf", str(out / "all.tar"), "-C", str(root), "."], check=True)
    with (out / "all.tar").open("rb") as stream:
        os.fsync(stream.fileno())


def run_pack(root: Path, out: Path, workers: int) -> None:
    pack(University1652(), PackingSettings(root=str(root), out=str(out), workers=workers))


def median_seconds(work: Callable[[Path], None], scratch: Path, repeats: int) -> float:
    """Median of `repeats`; each writes a new folder, which is removed afterwards."""
    durations = []
    for _ in range(repeats):
        out = scratch / "out"
        begin = time.perf_counter()
        work(out)
        durations.append(time.perf_counter() - begin)
        shutil.rmtree(out)
    return statistics.median(durations)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--images", type=int, default=20000)
    parser.add_argument("--side", type=int, default=512, help="pixels; University-1652 has 512")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--scratch", help="folder for the files; a temporary one by default")
    args = parser.parse_args()
    cluster.connect()
    with tempfile.TemporaryDirectory(dir=args.scratch) as folder:
        root, scratch = Path(folder) / "imagery", Path(folder)
        size = make_images(root, args.images, args.side)
        run_tar(root, scratch / "warm")
        shutil.rmtree(scratch / "warm")
        tar = median_seconds(partial(run_tar, root), scratch, args.repeats)
        print(
            f"shards: {args.images} images, {size / 1e6:.0f} MB; tar cf takes {tar:.2f} s, "
            f"{size / tar / 1e6:.0f} MB/s"
        )
        for workers, name in ((0, "this process"), (1, "one task"), (2, "two tasks")):
            seconds = median_seconds(
                partial(run_pack, root, workers=workers), scratch, args.repeats
            )
            print(
                f"shards: packing by {name} takes {seconds / tar:.2f} x tar's time, "
                f"{seconds:.2f} s, {args.images / seconds:.0f} images/s, "
                f"{size / seconds / 1e6:.0f} MB/s"
            )


if __name__ == "__main__":
    main()
