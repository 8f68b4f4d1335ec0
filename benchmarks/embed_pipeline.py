"""Embedding speed from tar to Parquet, as a ratio to the encoder alone, and its memory.

Prints one line per figure: images per second of one worker from tar to Parquet as a ratio to the
same encoder in the same worker, alternating, on tensors in memory (goal: at least 0.95); and a
worker's peak memory over many images as a ratio to a quarter of them (goal: 1).
"""

import argparse
import hashlib
import io
import json
import os
import resource
import sys
import tarfile
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import ray
from synthetic import jpegs

from jobs.encoding.encoder import make_encoder_spec
from jobs.encoding.probe_images import CALIBRATION_IMAGES, PROBE_IMAGES
from jobs.encoding.settings import EncoderSettings
from model.checkpoint import Checkpoint, dumps
from model.config import PVDAConfig
from model.pvda import FeatureEncoder
from pipeline.core import cluster
from pipeline.core.records import Split, View
from pipeline.features.embed_worker import IN_FLIGHT, EmbedJob, EncoderSpec, ShardEmbedder
from pipeline.features.settings import EmbeddingSettings
from pipeline.shards.external import EXTERNAL
from pipeline.shards.manifest import Manifest, Shard
from pipeline.shards.shard_set import ShardSet

SOURCE_SIDE = 512
"Side of the images in the tars, pixels: University-1652's."
SHARDS = 6
"Tars of a measured run."


class MeasuredEmbedder(ShardEmbedder):
    """The worker, plus measurements of its encoder and its memory."""

    def resident(self, images: int) -> float:
        """Images per second of the encoder alone."""
        return self._device.submit(self._resident, images).result()

    def _resident(self, images: int) -> float:
        size, batch = self._spec.image_size, self._job.batch_size
        bytes_BHW3 = np.random.default_rng(0).integers(0, 256, (batch, size, size, 3), np.uint8)
        begin = time.perf_counter()
        for start in range(0, images, batch):
            self._encoder(bytes_BHW3[: images - start].transpose(0, 3, 1, 2))
        return images / (time.perf_counter() - begin)

    def peak(self) -> float:
        """Peak memory in MB."""
        scale = 1e6 if sys.platform == "darwin" else 1e3  # bytes there, kilobytes elsewhere
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / scale


def write_shard(folder: str, number: int, images: list[bytes], count: int) -> Shard:
    """Write a tar of `count` images like those of jobs/make_shards.py; its manifest entry."""
    name = f"gallery-drone-{number:06d}"
    path = Path(folder) / f"{name}.tar"
    with tarfile.open(path, "w") as tar:
        for position in range(count):
            key = f"{name}-{position:06d}"
            metadata = {"key": key, "location": key, "view": "drone", "split": "gallery"}
            members = {
                "jpg": images[position % len(images)],
                "json": json.dumps(metadata | {"geotag": None}).encode(),
            }
            for suffix, data in members.items():
                member = tarfile.TarInfo(f"{key}.{suffix}")
                member.size = len(data)
                tar.addfile(member, io.BytesIO(data))
    data = path.read_bytes()
    return Shard(
        name=name,
        split=Split.GALLERY,
        view=View.DRONE,
        samples=count,
        bytes=len(data),
        sha256=hashlib.sha256(data).hexdigest(),
    )


def checkpoint(depth: Any, size: int, **config: Any) -> bytes:
    """A checkpoint of random weights; `config` overrides the network's other settings."""
    network = PVDAConfig(backbone=f"resnet{depth}", image_size=size, **config)
    weights = {"modules": {"encoder": FeatureEncoder(network).state_dict()}}
    return dumps(
        Checkpoint(network=network, recipe={}, locations=[], epoch=0, history=[], state=weights)
    )


def encoder_spec(
    weights: bytes,
    batch: int,
    folder: str,
    images: list[bytes],
    settings: EncoderSettings | None = None,
) -> EncoderSpec:
    """The encoder as a worker builds it; its probe images come from a separate shard."""
    probe_folder = Path(folder) / "probe"
    probe_folder.mkdir(exist_ok=True)
    write_shard(str(probe_folder), 0, images, PROBE_IMAGES + CALIBRATION_IMAGES)
    embedding = EmbeddingSettings(
        shards=str(probe_folder),
        out="none",
        split=Split.GALLERY,
        view=View.DRONE,
        batch_size=batch,
    )
    return make_encoder_spec(weights, "the benchmark's", embedding, settings)


def start_worker(folder: str, spec: EncoderSpec, batch: int, threads: int, decoders: int) -> Any:
    """A worker that has built its encoder; it writes its parts to `folder`/table."""
    job = EmbedJob(
        shards=ShardSet(
            path=folder,
            manifest=Manifest(
                shards=(), classes=(), packing={"source": EXTERNAL, "scattered": []}, rejected=0
            ),
        ),
        out=f"{folder}/table",
        batch_size=batch,
        dtype="float32",
        threads=threads,
        decode_threads=decoders,
    )
    actor: Any = (
        ray.remote(num_cpus=threads)(MeasuredEmbedder)
        .options(max_concurrency=IN_FLIGHT)
        .remote(job, spec)
    )
    ray.get(actor.start.remote())
    return actor


def end_to_end(actor: Any, shards: list[Shard]) -> tuple[float, Counter[str]]:
    """Images per second from tar to part, and the seconds that the worker's threads spent."""
    begin, spent = time.perf_counter(), Counter[str]()
    for _, done in cluster.bounded_map(actor.work.remote, shards, IN_FLIGHT):
        spent.update(done.seconds)
    seconds = time.perf_counter() - begin
    spent["idle"] = seconds - spent["infer"]  # type: ignore[assignment]
    return sum(shard.samples for shard in shards) / seconds, spent


def measure_speed(args: argparse.Namespace, images: list[bytes]) -> None:
    """Print the stage's images per second over the encoder's, the best of all rounds."""
    threads = args.threads or os.cpu_count() or 1
    with tempfile.TemporaryDirectory() as folder:
        spec = encoder_spec(
            checkpoint(args.depth, args.size, width=args.width), args.batch, folder, images
        )
        actor = start_worker(folder, spec, args.batch, threads, args.decoders)
        ray.get(actor.resident.remote(2 * args.batch))
        rate = ray.get(actor.resident.remote(4 * args.batch))
        each = max(2, round(rate * args.seconds / SHARDS / args.batch)) * args.batch
        shards = [write_shard(folder, number, images, each) for number in range(SHARDS)]
        stage, resident = list[float](), list[float]()
        for _ in range(args.rounds):
            resident.append(ray.get(actor.resident.remote(SHARDS * each // 2)))
            rate, spent = end_to_end(actor, shards)
            stage.append(rate)
            resident.append(ray.get(actor.resident.remote(SHARDS * each // 2)))
            shares = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in spent.items())
            print(
                f"  round: {rate:.1f} images/s through the stage, {max(resident[-2:]):.1f} "
                f"resident ({shares})"
            )
        # Other work on the machine can only slow a round down: compare the best of each.
        print(
            f"tar -> Parquet, ResNet-{args.depth} at {args.size} px, batches of {args.batch}, "
            f"{threads} threads, {args.decoders} decoding: {max(stage) / max(resident):.3f} x the "
            f"encoder alone (best of {args.rounds} rounds)"
        )
        ray.kill(actor)


def measure_memory(args: argparse.Namespace, images: list[bytes]) -> None:
    """Print a worker's peak memory over eight shards as a ratio to two."""
    with tempfile.TemporaryDirectory() as folder:
        shards = [write_shard(folder, number, images, args.few // 2) for number in range(8)]
        peaks = []
        spec = encoder_spec(checkpoint(18, 128), 32, folder, images)
        for count in (2, 8):
            actor = start_worker(folder, spec, 32, os.cpu_count() or 1, args.decoders)
            end_to_end(actor, shards[:count])
            peaks.append(ray.get(actor.peak.remote()))
            ray.kill(actor)
    low, high = peaks
    print(
        f"peak memory of a worker over {4 * args.few} images: {high / low:.3f} x that over "
        f"{args.few} ({high:.0f} MB, {low:.0f} MB)"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--depth", type=int, default=50, choices=(18, 34, 50, 101), help="layers of the ResNet")
    add("--width", type=float, default=1.0, help="its channels, as a multiple")
    add("--size", type=int, default=256, help="side of its images, pixels")
    add("--batch", type=int, default=8, help="images of a batch")
    add("--threads", type=int, help="threads of the encoder; all cores by default")
    add("--decoders", type=int, default=1, help="threads that decode")
    add("--seconds", type=float, default=8.0, help="length of a measured run, roughly")
    add("--rounds", type=int, default=3, help="alternating rounds")
    add("--distinct", type=int, default=100, help="distinct images, which the tars repeat")
    add("--few", type=int, default=1000, help="images of the memory baseline; 0: no memory run")
    args = parser.parse_args()
    cluster.connect()
    images = jpegs(args.distinct, SOURCE_SIDE, SOURCE_SIDE)
    measure_speed(args, images)
    if args.few:
        measure_memory(args, images)
    ray.shutdown()


if __name__ == "__main__":
    main()
