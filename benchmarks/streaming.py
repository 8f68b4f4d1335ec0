"""How fast one core reads, decodes and resizes images for the network, against a plain Pillow loop,
and in how much memory.

Prints one line per figure: images per second as a ratio to Pillow's (goal at 512 -> 256 px: at
least 2.5), the time to inspect an image, and the peak memory of a process that streams many images
over that of one that streams few (goal: 1).
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

from pipeline.batches.ordered import decode_samples
from pipeline.core.records import Split, View
from pipeline.images.decode import decode
from pipeline.images.inspect import inspect
from pipeline.images.transforms import resize
from pipeline.shards.samples import read_shard

CASES = {"512 -> 256": (512, 512, 256), "512 -> 64": (512, 512, 64), "256 -> 128": (256, 256, 128),
         "1000 x 750 -> 256": (1000, 750, 256)}  # fmt: skip
"Width and height of the images, and the side that they are brought to, in pixels."
DISTINCT = 200
"Images of a size; more are the same again."
ROUNDS = 5
"The two ways take turns, so that whatever else the machine does meets both."
MEMORY_SIDE, MEMORY_SHARD = 256, 1000
"Of the images that are streamed for their memory: pixels, and images in a shard."


def photos(width: int, height: int, count: int) -> list[bytes]:
    """JPEGs with the detail of a photo: noise at several scales, the finer the fainter; 512 px make
    some 50 kB.
    """
    rng, made = np.random.default_rng(0), []
    for _ in range(count):
        image = np.zeros((height, width, 3))
        for cells, share in ((4, 0.45), (16, 0.3), (64, 0.15), (256, 0.1)):
            coarse = Image.fromarray(rng.integers(0, 256, (cells, cells, 3), np.uint8))
            image += share * np.asarray(coarse.resize((width, height), Image.Resampling.BICUBIC))
        buffer = io.BytesIO()
        Image.fromarray(image.astype(np.uint8)).save(buffer, "JPEG", quality=90)
        made.append(buffer.getvalue())
    return made


def by_pillow(data: bytes, size: int) -> np.ndarray:
    with Image.open(io.BytesIO(data)) as image:
        return np.asarray(image.convert("RGB").resize((size, size), Image.Resampling.BICUBIC))


def by_ours(data: bytes, size: int) -> np.ndarray:
    return resize(decode(data), size)


def speed(work: Callable[[bytes, int], np.ndarray], images: list[bytes], size: int) -> float:
    """Images per second."""
    began = time.perf_counter()
    for data in images:
        work(data, size)
    return len(images) / (time.perf_counter() - began)


def measure_speed(distinct: int) -> None:
    for name, (width, height, size) in CASES.items():
        images = photos(width, height, distinct)
        by_ours(images[0], size)  # torch is imported
        rounds = [
            (speed(by_ours, images, size), speed(by_pillow, images, size)) for _ in range(ROUNDS)
        ]
        ours, pillow = (float(np.median(column)) for column in zip(*rounds, strict=True))
        ratios = ", ".join(f"{one / other:.2f}" for one, other in rounds)
        kilobytes = np.mean([len(data) for data in images]) / 1000
        print(
            f"{name} px, JPEG of {kilobytes:.0f} kB: {ours / pillow:.2f} x Pillow's speed, {ours:.0f} images/s per core "
            f"(rounds: {ratios})"
        )
        began = time.perf_counter()
        for data in images:
            inspect(data)
        seconds = (time.perf_counter() - began) / len(images)
        print(
            f"{name} px: inspection {1e6 * seconds:.1f} microseconds, {seconds * ours:.4f} x decoding and resizing"
        )


def write_shards(folder: Path, count: int, distinct: int) -> None:
    """Tars of a thousand images each, without a manifest: as others make them."""
    images = photos(MEMORY_SIDE, MEMORY_SIDE, distinct)
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
        samples = read_shard(folder, path.stem, Split.GALLERY, View.SATELLITE)
        for _, image in decode_samples(samples, 128, 2, 64):
            assert isinstance(image, np.ndarray)
            yield float(image[0, 0, 0])
            left -= 1
            if left == 0:
                return


def peak(folder: str, count: int) -> float:
    """Peak memory in MB of a process of its own that streams so many images."""
    command = [sys.executable, __file__, "--stream", folder, "--images", str(count)]
    told = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    return float(told.stdout)


def measure_memory(few: int, many: int, distinct: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        write_shards(Path(folder), many, distinct)
        low, high = peak(folder, few), peak(folder, many)
    print(
        f"peak memory of {many} images streamed: {high / low:.3f} x that of {few} ({high:.0f} MB, {low:.0f} MB)"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--distinct", type=int, default=DISTINCT, help="images made of each size")
    parser.add_argument(
        "--few", type=int, default=2_000, help="images streamed for the memory to compare with"
    )
    parser.add_argument("--many", type=int, default=20_000, help="images streamed for the memory")
    parser.add_argument(
        "--stream",
        metavar="DIR",
        help="only stream the shards of this folder and print the peak memory",
    )
    parser.add_argument("--images", type=int, default=2_000, help="with --stream: how many")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.stream:
        import resource  # not on Windows, where the figure is not printed

        for _ in stream(given.stream, given.images):
            pass
        scale = 1e6 if sys.platform == "darwin" else 1e3  # bytes there, kilobytes elsewhere
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / scale)
        return
    print(f"torch {torch.__version__}, {torch.backends.cpu.get_cpu_capability()}, one core")
    measure_speed(given.distinct)
    measure_memory(given.few, given.many, given.distinct)


if __name__ == "__main__":
    main()
