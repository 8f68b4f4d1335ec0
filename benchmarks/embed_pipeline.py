"""Embedding speed from tar to Parquet, as a ratio to the encoder alone, and its memory.

Prints one line per figure: images per second of one worker from tar to Parquet as a ratio to the
same encoder in the same worker, alternating, on tensors in memory (goal: at least 0.95); and a
worker's peak memory over many images as a ratio to a quarter of them (goal: 1).
"""

import argparse
import os
import tempfile
import time
from collections import Counter
from dataclasses import replace
from typing import Any, get_args

import ray
from embedding_worker import (
    SOURCE_SIDE,
    MeasuredEmbedder,
    checkpoint,
    embed_job,
    encoder_spec,
    recipe_of,
    write_shard,
)
from synthetic import jpegs

from jobs.encoding.encoder import read_checkpoint_bytes
from jobs.encoding.settings import Compiling, EncoderSettings
from model.backbones import BACKBONES
from model.checkpoint import dumps, loads
from model.inference.precision import EffectivePrecision
from pipeline.core import cluster
from pipeline.features.embed_worker import IN_FLIGHT, EncoderSpec
from pipeline.shards.manifest import Shard

SHARDS = 6
"Tars of a measured run."


def start_worker(folder: str, spec: EncoderSpec, batch: int, threads: int, decoders: int) -> Any:
    """A worker that has built its encoder; it writes its parts to `folder`/table."""
    job = embed_job(folder, batch, threads, decoders)
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


def weights(args: argparse.Namespace) -> bytes:
    """The bytes of a trained checkpoint for images of the size asked for, or of random weights. Of
    a random EfficientNet hardly anything reaches the last maps, nothing at all in int8.
    """
    if not args.checkpoint:
        return checkpoint(recipe_of(args.backbone, args.width, args.size))
    trained = loads(read_checkpoint_bytes(args.checkpoint), args.checkpoint)
    return dumps(replace(trained, network=replace(trained.network, image_size=args.size)))


def measure_speed(args: argparse.Namespace, images: list[bytes]) -> None:
    """Print the stage's images per second over the encoder's, the best of all rounds."""
    threads = args.threads or os.cpu_count() or 1
    with tempfile.TemporaryDirectory() as folder:
        spec = encoder_spec(
            weights(args),
            args.batch,
            folder,
            images,
            EncoderSettings(compiling=args.compiling, precision=args.precision),
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
            f"tar -> Parquet, {args.checkpoint or args.backbone} at {args.size} px in "
            f"{args.precision}, batches of {args.batch}, {threads} threads, {args.decoders} "
            "decoding: "
            f"{max(stage) / max(resident):.3f} x the encoder alone (best of {args.rounds} rounds)"
        )
        ray.kill(actor)


def measure_memory(args: argparse.Namespace, images: list[bytes]) -> None:
    """Print a worker's peak memory over eight shards as a ratio to two."""
    with tempfile.TemporaryDirectory() as folder:
        shards = [write_shard(folder, number, images, args.few // 2) for number in range(8)]
        peaks = []
        spec = encoder_spec(checkpoint(recipe_of("resnet18", 1.0, 128)), 32, folder, images)
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
    add("--checkpoint", help="builtin, or a last.pt; by default random weights")
    add("--backbone", default="resnet50", choices=BACKBONES, help="with its recipe's rings")
    add("--width", type=float, default=1.0, help="its channels, as a multiple")
    add("--size", type=int, default=256, help="side of its images, pixels")
    add("--batch", type=int, default=8, help="images of a batch")
    add("--compiling", default="auto", choices=get_args(Compiling), help="of the encoder")
    add(
        "--precision",
        default="float32",
        choices=get_args(EffectivePrecision),
        help="of the encoder",
    )
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
