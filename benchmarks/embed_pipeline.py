"""What embedding loses between the tar and the Parquet part: the stage's speed over that of the
encoder alone, and its memory.

Prints one line per figure: images per second from tar to Parquet by one worker as a ratio to the
same encoder, in the same worker and by turns, on tensors that are there already (goal: at least
0.95); and a worker's peak memory over many images to that over a quarter of them (goal: 1).
"""

import argparse
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
from PIL import Image

from jobs.encoding.encoder import (
    CALIBRATION_IMAGES,
    PROBE_IMAGES,
    EncoderSettings,
    make_encoder_spec,
)
from model.checkpoint import Checkpoint, dumps
from model.pvda import FeatureEncoder, PVDAConfig
from pipeline.core import cluster
from pipeline.core.records import Split, View
from pipeline.features.embed import EmbeddingSettings
from pipeline.features.embed_worker import IN_FLIGHT, EmbedJob, EncoderSpec, ShardEmbedder
from pipeline.shards.manifest import Shard

SOURCE_SIDE = 512
"Of the images in the tars: University-1652's."
DISTINCT = 100
"Images; more are the same again."
SHARDS = 6
"Tars of a measured run."


class Measured(ShardEmbedder):
    """The worker, with a look at its encoder and its memory."""

    def resident(self, images: int) -> float:
        """Images per second of the encoder alone."""
        return self._device.submit(self._resident, images).result()

    def _resident(self, images: int) -> float:
        size, batch = self._network.image_size, self._given.batch_size
        bytes_BHW3 = np.random.default_rng(0).integers(0, 256, (batch, size, size, 3), np.uint8)
        began = time.perf_counter()
        for start in range(0, images, batch):
            self._encoder(bytes_BHW3[: images - start].transpose(0, 3, 1, 2))
        return images / (time.perf_counter() - began)

    def peak(self) -> float:
        """Peak memory in MB."""
        scale = 1e6 if sys.platform == "darwin" else 1e3  # bytes there, kilobytes elsewhere
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / scale


def photo(rng: np.random.Generator) -> bytes:
    """A JPEG with the detail of a photo: noise at several scales, the finer the fainter; some 50
    kB.
    """
    image = np.zeros((SOURCE_SIDE, SOURCE_SIDE, 3))
    for cells, share in ((4, 0.45), (16, 0.3), (64, 0.15), (256, 0.1)):
        coarse = Image.fromarray(rng.integers(0, 256, (cells, cells, 3), np.uint8))
        image += share * np.asarray(
            coarse.resize((SOURCE_SIDE, SOURCE_SIDE), Image.Resampling.BICUBIC)
        )
    buffer = io.BytesIO()
    Image.fromarray(image.astype(np.uint8)).save(buffer, "JPEG", quality=90)
    return buffer.getvalue()


def write_shard(folder: str, number: int, images: list[bytes], count: int) -> Shard:
    """A tar as jobs/make_shards.py writes it."""
    name = f"gallery-drone-{number:06d}"
    with tarfile.open(Path(folder) / f"{name}.tar", "w") as tar:
        for position in range(count):
            key = f"{name}-{position:06d}"
            said = {
                "key": key,
                "location": key,
                "view": "drone",
                "split": "gallery",
                "geotag": None,
            }
            for ending, data in (
                ("jpg", images[position % len(images)]),
                ("json", json.dumps(said).encode()),
            ):
                member = tarfile.TarInfo(f"{key}.{ending}")
                member.size = len(data)
                tar.addfile(member, io.BytesIO(data))
    return Shard(
        name=name, split=Split.GALLERY, view=View.DRONE, samples=count, bytes=0, sha256="s"
    )


def checkpoint(depth: Any, size: int) -> bytes:
    """A network with the weights that chance gave it."""
    config = PVDAConfig(depth=depth, image_size=size)
    weights = {"modules": {"encoder": FeatureEncoder(config).state_dict()}}
    return dumps(
        Checkpoint(network=config, recipe={}, locations=[], epoch=0, history=[], state=weights)
    )


def network(
    made: bytes,
    batch: int,
    folder: str,
    images: list[bytes],
    settings: EncoderSettings | None = None,
) -> EncoderSpec:
    """The network as a worker builds it, checked by images of a shard of its own."""
    apart = Path(folder) / "probe"
    apart.mkdir(exist_ok=True)
    write_shard(str(apart), 0, images, PROBE_IMAGES + CALIBRATION_IMAGES)
    embedding = EmbeddingSettings(
        shards=str(apart), out="none", split=Split.GALLERY, view=View.DRONE, batch_size=batch
    )
    return make_encoder_spec(made, "the benchmark's", embedding, settings)


def worker(folder: str, made: EncoderSpec, batch: int, threads: int, decoders: int) -> Any:
    given = EmbedJob(
        shards=folder,
        out=f"{folder}/table",
        batch_size=batch,
        dtype="float32",
        threads=threads,
        decode_threads=decoders,
    )
    actor: Any = (
        ray.remote(num_cpus=threads)(Measured)
        .options(max_concurrency=IN_FLIGHT)
        .remote(given, made)
    )
    ray.get(actor.start.remote())
    return actor


def end_to_end(actor: Any, shards: list[Shard]) -> tuple[float, Counter[str]]:
    """Images per second from tar to part, and where the threads' seconds went."""
    began, spent = time.perf_counter(), Counter[str]()
    for _, done in cluster.bounded_map(actor.work.remote, shards, IN_FLIGHT):
        spent.update(done.seconds)
    seconds = time.perf_counter() - began
    spent["idle"] = seconds - spent["infer"]  # type: ignore[assignment]
    return sum(shard.samples for shard in shards) / seconds, spent


def measure_speed(given: argparse.Namespace, images: list[bytes]) -> None:
    threads = given.threads or os.cpu_count() or 1
    with tempfile.TemporaryDirectory() as folder:
        actor = worker(
            folder,
            network(checkpoint(given.depth, given.size), given.batch, folder, images),
            given.batch,
            threads,
            given.decoders,
        )
        ray.get(actor.resident.remote(2 * given.batch))
        rate = ray.get(actor.resident.remote(4 * given.batch))
        each = max(2, round(rate * given.seconds / SHARDS / given.batch)) * given.batch
        shards = [write_shard(folder, number, images, each) for number in range(SHARDS)]
        through, alone = [], []
        for _ in range(given.rounds):
            alone.append(ray.get(actor.resident.remote(SHARDS * each // 2)))
            rate, spent = end_to_end(actor, shards)
            through.append(rate)
            alone.append(ray.get(actor.resident.remote(SHARDS * each // 2)))
            told = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in spent.items())
            print(
                f"  round: {rate:.1f} images/s through the stage, {max(alone[-2:]):.1f} resident ({told})"
            )
        # Other work on the machine only ever slows: the best of either is what it can do.
        print(
            f"tar -> Parquet, ResNet-{given.depth} at {given.size} px, batches of {given.batch}, {threads} threads, "
            f"{given.decoders} that decode: {max(through) / max(alone):.3f} x the encoder alone (best of {given.rounds} rounds)"
        )
        ray.kill(actor)


def measure_memory(given: argparse.Namespace, images: list[bytes]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        shards = [write_shard(folder, number, images, given.few // 2) for number in range(8)]
        peaks = []
        made = network(checkpoint(18, 128), 32, folder, images)
        for count in (2, 8):
            actor = worker(folder, made, 32, os.cpu_count() or 1, given.decoders)
            end_to_end(actor, shards[:count])
            peaks.append(ray.get(actor.peak.remote()))
            ray.kill(actor)
    low, high = peaks
    print(
        f"peak memory of a worker over {4 * given.few} images: {high / low:.3f} x that over {given.few} ({high:.0f} MB, "
        f"{low:.0f} MB)"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--depth", type=int, default=50, choices=(18, 34, 50, 101), help="layers of the ResNet"
    )
    parser.add_argument("--size", type=int, default=256, help="side of its images in pixels")
    parser.add_argument("--batch", type=int, default=8, help="images of a pass")
    parser.add_argument("--threads", type=int, help="of the encoder; all cores by default")
    parser.add_argument("--decoders", type=int, default=1, help="threads that decode")
    parser.add_argument("--seconds", type=float, default=8.0, help="of a measured run, roughly")
    parser.add_argument("--rounds", type=int, default=3, help="of the two in turn")
    parser.add_argument(
        "--few", type=int, default=1000, help="images for the memory to compare with"
    )
    given = parser.parse_args()
    cluster.connect()
    rng = np.random.default_rng(0)
    images = [photo(rng) for _ in range(DISTINCT)]
    measure_speed(given, images)
    if given.few:
        measure_memory(given, images)
    ray.shutdown()


if __name__ == "__main__":
    main()
