"""Embedding against a plain script that does what the field's test scripts do, in one run; prints
one line per figure.

The script: PyTorch as it comes (eager, float32, channels first), a DataLoader over image files,
Pillow to decode and resize, image and mirror image in two passes. Ours: one worker from tar to
Parquet part, float32 compiled (goal: at least 1.8 x the script) and int8 (goal: at least 5 x).
Beside each: the cosine of its embeddings with the script's. By turns, the best of each.

    python benchmarks/embed_script.py [--images 96]
"""

import argparse
import io
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import ray
import torch
from embed_pipeline import DISTINCT, checkpoint, end_to_end, network, photo, worker, write_shard
from PIL import Image
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from jobs.encoding.encoder import EncoderSettings
from model.checkpoint import build_encoder, loads
from pipeline.core import cluster
from pipeline.features.table import Floats


class Files(Dataset[Tensor]):
    """Image files, decoded and resized by Pillow."""

    def __init__(self, paths: list[Path], size: int) -> None:
        self.paths, self.size = paths, size

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> Tensor:
        with Image.open(io.BytesIO(self.paths[index].read_bytes())) as image:
            small = image.convert("RGB").resize((self.size, self.size), Image.Resampling.BICUBIC)
        return torch.from_numpy(np.asarray(small).transpose(2, 0, 1).copy())


def script(made: bytes, paths: list[Path], size: int, batch: int) -> tuple[float, Floats]:
    """Images per second of the plain script, and its embeddings."""
    encoder = build_encoder(loads(made)).to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    loader: DataLoader[Tensor] = DataLoader(Files(paths, size), batch_size=batch, num_workers=2)
    found = []
    began = time.perf_counter()
    with torch.no_grad():
        for images_B3HW in loader:
            g_BPD = encoder(images_B3HW)[1] + encoder(images_B3HW.flip(3))[1]
            unit_BPD = torch.nn.functional.normalize(g_BPD, dim=2) / g_BPD.shape[1] ** 0.5
            found.append(unit_BPD.flatten(1).numpy())
    return len(paths) / (time.perf_counter() - began), np.concatenate(found)


def ours(
    made: bytes, images: list[bytes], folder: str, given: argparse.Namespace, precision: str
) -> Callable[[], tuple[float, Floats]]:
    """A worker that is there already; each call embeds all images from tars to parts."""
    settings = EncoderSettings(precision=precision, compiling="always")  # type: ignore[arg-type]
    actor = worker(
        folder, network(made, given.batch, folder, images, settings), given.batch, given.threads, 1
    )
    half = given.images // 2
    shards = [
        write_shard(folder, number, images[number * half :] + images[: number * half], half)
        for number in range(2)
    ]

    def measured() -> tuple[float, Floats]:
        rate, _ = end_to_end(actor, shards)
        parts = [
            pq.read_table(f"{folder}/table/{shard.name}.parquet", columns=["embedding"])
            for shard in shards
        ]
        flat = [part["embedding"].combine_chunks().flatten().to_numpy() for part in parts]
        return rate, np.concatenate(flat).reshape(given.images, -1)

    return measured


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument(
        "--depth", type=int, default=50, choices=(18, 34, 50, 101), help="layers of the ResNet"
    )
    parser.add_argument("--size", type=int, default=256, help="side of its images in pixels")
    parser.add_argument("--batch", type=int, default=16, help="images of a pass")
    parser.add_argument("--images", type=int, default=64, help="of a measured run; even")
    parser.add_argument("--rounds", type=int, default=2, help="of all in turn")
    parser.add_argument("--threads", type=int, default=2, help="of the encoder")
    given = parser.parse_args()
    cluster.connect()
    torch.set_num_threads(given.threads)
    rng = np.random.default_rng(0)
    images = [photo(rng) for _ in range(min(DISTINCT, given.images))]
    images = [images[number % len(images)] for number in range(given.images)]
    made = checkpoint(given.depth, given.size)
    with tempfile.TemporaryDirectory() as folder:
        paths = []
        for number, data in enumerate(images):
            paths.append(Path(folder) / f"{number:05d}.jpg")
            paths[-1].write_bytes(data)
        for precision in ("float32", "int8"):  # one worker at a time: two would share the cores
            print(
                f"tar -> Parquet in {precision}, ResNet-{given.depth} at {given.size} px, mirrored: ",
                flush=True,
            )
            print(
                compare(precision, made, images, paths, str(Path(folder) / precision), given),
                flush=True,
            )
            ray.shutdown()
            cluster.connect()
    ray.shutdown()


def compare(
    precision: str,
    made: bytes,
    images: list[bytes],
    paths: list[Path],
    folder: str,
    given: argparse.Namespace,
) -> str:
    """Ours and the script by turns: what is to be said of them."""
    Path(folder).mkdir()
    run = ours(made, images, folder, given, precision)
    by_script, by_us = [], []
    for _ in range(given.rounds):
        rate, expected_NE = script(made, paths, given.size, given.batch)
        by_script.append(rate)
        rate, found_NE = run()
        by_us.append(rate)
        print(f"  script {by_script[-1]:.2f} images/s, ours {by_us[-1]:.2f}", flush=True)
    cosine_N = (found_NE * expected_NE).sum(1)
    return (
        f"  {max(by_us) / max(by_script):.2f} x the plain script (best of {given.rounds} each), cosine with it "
        f"{cosine_N.mean():.6f} in the mean, {cosine_N.min():.6f} at worst"
    )


if __name__ == "__main__":
    main()
