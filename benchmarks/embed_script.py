"""Embedding speed as a ratio to a plain script like those of the field, in one run.

The script: PyTorch's defaults (eager, float32, channels first), a DataLoader over image files,
decoding and resizing by Pillow, image and mirror image in two passes. Ours: one worker from tar to
Parquet part, float32 compiled (goal: at least 1.8 x the script) and int8 (goal: at least 5 x),
each with the cosine of its embeddings to the script's. Both alternate; the best round of each
counts. Prints one line per figure.

    python benchmarks/embed_script.py [--images 96]
"""

import argparse
import io
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import ray
import torch
from embed_pipeline import end_to_end, start_worker
from embedding_worker import SOURCE_SIDE, checkpoint, encoder_spec, recipe_of, write_shard
from PIL import Image
from synthetic import jpegs
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from jobs.encoding.settings import EncoderSettings
from model.backbones import BACKBONES
from model.checkpoint import build_encoder, loads
from pipeline.core import cluster
from pipeline.core.arrays import Floats

RESNETS = [name for name in BACKBONES if name.startswith("resnet")]


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


def plain_script(weights: bytes, paths: list[Path], size: int, batch: int) -> tuple[float, Floats]:
    """Images per second of the plain script, and its embeddings."""
    encoder = build_encoder(loads(weights))
    encoder.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    loader: DataLoader[Tensor] = DataLoader(Files(paths, size), batch_size=batch, num_workers=2)
    found = []
    begin = time.perf_counter()
    with torch.no_grad():
        for images_B3HW in loader:
            g_BPD = encoder(images_B3HW)[1] + encoder(images_B3HW.flip(3))[1]
            unit_BPD = torch.nn.functional.normalize(g_BPD, dim=2) / g_BPD.shape[1] ** 0.5
            found.append(unit_BPD.flatten(1).numpy())
    return len(paths) / (time.perf_counter() - begin), np.concatenate(found)


def pipeline_runner(
    weights: bytes, images: list[bytes], folder: str, args: argparse.Namespace, precision: Any
) -> Callable[[], tuple[float, Floats]]:
    """Start a worker; each call of the result embeds all images from tars to parts."""
    settings = EncoderSettings(precision=precision, compiling=args.compiling)
    spec = encoder_spec(weights, args.batch, folder, images, settings)
    actor = start_worker(folder, spec, args.batch, args.threads, 1)
    half = args.images // 2
    shards = [
        write_shard(folder, number, images[number * half :] + images[: number * half], half)
        for number in range(2)
    ]

    def run() -> tuple[float, Floats]:
        rate, _ = end_to_end(actor, shards)
        parts = [
            pq.read_table(f"{folder}/table/{shard.name}.parquet", columns=["embedding"])
            for shard in shards
        ]
        flat = [part["embedding"].combine_chunks().flatten().to_numpy() for part in parts]
        return rate, np.concatenate(flat).reshape(args.images, -1)

    return run


def compare(
    precision: Any,
    weights: bytes,
    images: list[bytes],
    paths: list[Path],
    folder: str,
    args: argparse.Namespace,
) -> str:
    """Alternate the script and the pipeline; the line to print."""
    Path(folder).mkdir()
    run = pipeline_runner(weights, images, folder, args, precision)
    script_rates, our_rates = [], []
    for _ in range(args.rounds):
        rate, expected_NE = plain_script(weights, paths, args.size, args.batch)
        script_rates.append(rate)
        rate, found_NE = run()
        our_rates.append(rate)
        print(f"  script {script_rates[-1]:.2f} images/s, ours {our_rates[-1]:.2f}", flush=True)
    cosine_N = (found_NE * expected_NE).sum(1)
    return (
        f"  {max(our_rates) / max(script_rates):.2f} x the plain script (best of {args.rounds} "
        f"each), cosine with it {cosine_N.mean():.6f} in the mean, {cosine_N.min():.6f} at worst"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    add = parser.add_argument
    add("--backbone", default="resnet50", choices=RESNETS, help="the script embeds mirror images")
    add("--width", type=float, default=1.0, help="its channels, as a multiple")
    add("--size", type=int, default=256, help="side of its images, pixels")
    add("--batch", type=int, default=16, help="images of a batch")
    add("--images", type=int, default=64, help="images of a measured run; an even number")
    add("--distinct", type=int, default=100, help="distinct images, which the run repeats")
    add("--rounds", type=int, default=2, help="alternating rounds")
    add("--threads", type=int, default=2, help="threads of the encoder")
    add("--precisions", nargs="+", default=["float32", "int8"], help="float32, int8")
    add("--compiling", default="always", help="always or never compile our encoder")
    args = parser.parse_args()
    cluster.connect()
    torch.set_num_threads(args.threads)
    distinct = jpegs(min(args.distinct, args.images), SOURCE_SIDE, SOURCE_SIDE)
    images = [distinct[number % len(distinct)] for number in range(args.images)]
    weights = checkpoint(recipe_of(args.backbone, args.width, args.size))
    with tempfile.TemporaryDirectory() as folder:
        paths = []
        for number, data in enumerate(images):
            paths.append(Path(folder) / f"{number:05d}.jpg")
            paths[-1].write_bytes(data)
        for precision in args.precisions:  # one worker at a time: two would share the cores
            name = f"{args.backbone} at {args.size} px, mirrored"
            print(f"tar -> Parquet in {precision}, {name}:", flush=True)
            scratch = str(Path(folder) / precision)
            print(compare(precision, weights, images, paths, scratch, args), flush=True)
            ray.shutdown()
            cluster.connect()
    ray.shutdown()


if __name__ == "__main__":
    main()
