"""Reading, decoding and resizing on one core, as a ratio to a plain Pillow loop, and its memory.

Prints one line per figure: images per second as a ratio to Pillow's (goal for 512 -> 256 px: at
least 2.5), the time to inspect an image as a ratio to decoding it, and the peak memory of a process
that streams many images as a ratio to one that streams few (goal: 1).
"""

import argparse
import io
import os
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from synthetic import jpegs

from pipeline.batches.ordered import decode_samples
from pipeline.core.records import Split, View
from pipeline.images.decode import decode
from pipeline.images.inspect import inspect
from pipeline.images.transforms import resize
from pipeline.shards.samples import read_samples

CASES = {
    "512 -> 256": (512, 512, 256),
    "512 -> 64": (512, 512, 64),
    "256 -> 128": (256, 256, 128),
    "1000 x 750 -> 256": (1000, 750, 256),
}
"Width, height and output side of the images, pixels."
ROUNDS = 5
"Alternating rounds, so that other work on the machine slows both."
MEMORY_SIDE, MEMORY_SHARD = 256, 1000
"Side in pixels of the images of the memory run, and images per shard."


def with_pillow(data: bytes, size: int) -> np.ndarray:
    with Image.open(io.BytesIO(data)) as image:
        return np.asarray(image.convert("RGB").resize((size, size), Image.Resampling.BICUBIC))


def with_pipeline(data: bytes, size: int) -> np.ndarray:
    return resize(decode(data), size)


def rate(work: Callable[[bytes, int], np.ndarray], images: list[bytes], size: int) -> float:
    """Images per second."""
    begin = time.perf_counter()
    for data in images:
        work(data, size)
    return len(images) / (time.perf_counter() - begin)


def measure_speed(distinct: int) -> None:
    for name, (width, height, size) in CASES.items():
        images = jpegs(distinct, width, height)
        with_pipeline(images[0], size)  # the first call imports torch
        rounds = [
            (rate(with_pipeline, images, size), rate(with_pillow, images, size))
            for _ in range(ROUNDS)
        ]
        ours, pillow = (float(np.median(column)) for column in zip(*rounds, strict=True))
        ratios = ", ".join(f"{one / other:.2f}" for one, other in rounds)
        kilobytes = np.mean([len(data) for data in images]) / 1000
        print(
            f"{name} px, JPEG of {kilobytes:.0f} kB: {ours / pillow:.2f} x Pillow's speed, "
            f"{ours:.0f} images/s per core (rounds: {ratios})"
        )
        begin = time.perf_counter()
        for data in images:
            inspect(data)
        seconds = (time.perf_counter() - begin) / len(images)
        print(
            f"{name} px: inspection {1e6 * seconds:.1f} microseconds, {seconds * ours:.4f} x "
            "decoding and resizing"
        )


def write_shards(folder: Path, count: int, distinct: int) -> None:
    """Tars of a thousand images each without a manifest, as other programs write them."""
    images = jpegs(distinct, MEMORY_SIDE, MEMORY_SIDE)
    for start in range(0, count, MEMORY_SHARD):
        with tarfile.open(folder / f"{start:06d}.tar", "w") as tar:
            for number in range(start, min(start + MEMORY_SHARD, count)):
                member = tarfile.TarInfo(f"{number:06d}.jpg")
                member.size = len(images[number % distinct])
                tar.addfile(member, io.BytesIO(images[number % distinct]))


def stream(folder: str, count: int) -> Iterator[float]:
    """Stream images as the embedder does."""
    left = count
    for path in sorted(Path(folder).glob("*.tar")):
        samples = read_samples(str(path), external=(Split.GALLERY, View.SATELLITE))
        for _, image in decode_samples(samples, 128, 2, 64):
            assert isinstance(image, np.ndarray)
            yield float(image[0, 0, 0])
            left -= 1
            if left == 0:
                return


def peak_memory(folder: str, count: int) -> float:
    """Peak memory in MB of a separate process that streams so many images."""
    command = [sys.executable, __file__, "--stream", folder, "--images", str(count)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    run = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    return float(run.stdout)


def measure_memory(few: int, many: int, distinct: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        write_shards(Path(folder), many, distinct)
        low, high = peak_memory(folder, few), peak_memory(folder, many)
    print(
        f"peak memory of {many} images streamed: {high / low:.3f} x that of {few} "
        f"({high:.0f} MB, {low:.0f} MB)"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--distinct", type=int, default=200, help="distinct images of each size")
    add("--few", type=int, default=2_000, help="images of the memory baseline")
    add("--many", type=int, default=20_000, help="images of the memory run")
    add("--stream", metavar="DIR", help="only stream this folder's shards, print the peak memory")
    add("--images", type=int, default=2_000, help="with --stream: how many")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.stream:
        import resource  # not on Windows, where the figure is not printed

        for _ in stream(args.stream, args.images):
            pass
        scale = 1e6 if sys.platform == "darwin" else 1e3  # bytes there, kilobytes elsewhere
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / scale)
        return
    print(f"torch {torch.__version__}, {torch.backends.cpu.get_cpu_capability()}, one core")
    measure_speed(args.distinct)
    measure_memory(args.few, args.many, args.distinct)


if __name__ == "__main__":
    main()
