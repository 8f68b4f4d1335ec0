"""Shards + encoder -> feature table: Ray actors that hold the encoder, one Parquet part per shard, done parts skipped.

The encoder comes as a factory that is called on the worker; what it computes is named by a fingerprint.
Shapes: B images of a batch, H x W pixels, D dimensions of an embedding.
"""

import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice

import numpy as np
import numpy.typing as npt
import ray
from ray.util import ActorPool

from pipeline import cluster, storage
from pipeline.features import Floats, PartFooter, PartRows, read_footer, write_part
from pipeline.foreign import open_manifest
from pipeline.progress import console, progress
from pipeline.records import InputError, Rejection, Split, View
from pipeline.samples import Sample, read_shard
from pipeline.shards import Manifest, Shard
from pipeline.stream import decoded, stack
from pipeline.transforms import DecodeError, Pixels, Resizer

Encoder = Callable[[npt.NDArray[np.uint8]], Floats]
"Images as bytes (B, 3, H, W) -> unit vectors (B, D), float32."


@dataclass(frozen=True, kw_only=True)
class EmbeddingSettings:
    """Which shards are embedded into which table, and how the work is spread."""

    shards: str
    "Folder or URI of the shards."
    out: str
    "Folder or URI of the feature table."
    split: Split | None = None
    "Only this split; of shards that others made, which have no manifest, what they are."
    view: View | None = None
    "Only this view; likewise."
    batch_size: int = 32
    "Images per forward pass."
    dtype: str = "float32"
    "Of the stored embeddings: float32, or float16 for half the space."
    workers: int | None = None
    "Actors; by default one per GPU, or one per eight CPU cores."
    cpus_per_worker: int | None = None
    "CPU cores of an actor; by default an even share of the cluster's."
    gpus_per_worker: float = 0
    "GPUs of an actor."

    def __post_init__(self) -> None:
        if self.batch_size < 1:
            raise InputError(f"--batch-size is {self.batch_size}, expected at least 1")
        if self.dtype not in ("float32", "float16"):
            raise InputError(f"--dtype is {self.dtype!r}, expected float32 or float16")
        if self.workers is not None and self.workers < 1:
            raise InputError(f"--workers is {self.workers}, expected at least 1")


@dataclass(frozen=True, kw_only=True)
class Network:
    """The encoder as the embedder needs to know it."""

    fingerprint: str
    "Of weights, config and preprocessing."
    image_size: int
    "Side in pixels of the images that it takes."
    resizer: Resizer = "torch"
    "Whose bicubic brings them to it."
    factory: Callable[[int], Encoder]
    "Called once on each worker, with the number of threads that it may use."


def is_done(path: str, fingerprint: str, shard: Shard) -> bool:
    """Whether a part is there, complete, and made of this shard.

    Raises InputError when it was made by another network.
    """
    if not storage.exists(path):
        return False
    footer = read_footer(path)
    if footer.fingerprint != fingerprint:
        raise InputError(
            f"{path} was made by network {footer.fingerprint[:12]}, this checkpoint is {fingerprint[:12]}; choose another "
            "--out, the --resizer that it was made with, or delete the old table"
        )
    return footer.shard_sha256 == shard.sha256 and footer.rows + len(footer.rejected) == shard.samples


class ShardEmbedder:
    """One worker: loads the encoder once, then embeds shard after shard."""

    def __init__(self, settings: EmbeddingSettings, network: Network, cpus: int) -> None:
        self.settings, self.network, self.threads = settings, network, cpus
        self.encoder = network.factory(cpus)

    def embed(self, shard: Shard) -> tuple[Shard, dict[str, float]]:
        """Embed one shard and write its part; returns where the seconds went."""
        settings, network, seconds = self.settings, self.network, defaultdict[str, float](float)
        depth = 2 * settings.batch_size
        read = read_shard(settings.shards, shard.name, shard.split, shard.view)
        ready = decoded(read, network.image_size, self.threads, depth, network.resizer)
        samples: list[Sample] = []
        rejected: list[Rejection] = []
        blocks: list[Floats] = []
        while True:
            start = time.perf_counter()
            group = list(islice(ready, settings.batch_size))
            seconds["read and decode"] += time.perf_counter() - start
            if not group:
                break
            images: list[Pixels] = []
            for sample, image in group:
                if isinstance(image, DecodeError):
                    rejected.append(Rejection(path=sample.key, reason=image.reason, found=image.found))
                else:
                    samples.append(sample)
                    images.append(image)
            start = time.perf_counter()
            if images:
                blocks.append(self.encoder(stack(images)))
            seconds["infer"] += time.perf_counter() - start
        start = time.perf_counter()
        self._write(shard, samples, blocks, rejected)
        seconds["write"] += time.perf_counter() - start
        return shard, dict(seconds)

    def _write(self, shard: Shard, samples: list[Sample], blocks: list[Floats], rejected: list[Rejection]) -> None:
        if not blocks:
            raise RuntimeError(f"not one image of {shard.name}.tar can be decoded; verify the shards and pack it again")
        tags = [sample.facts["geotag"] or {} for sample in samples]
        rows = PartRows(
            keys=[sample.key for sample in samples],
            locations=[sample.facts["location"] for sample in samples],
            views=[sample.facts["view"] for sample in samples],
            splits=[sample.facts["split"] for sample in samples],
            lats=[tag.get("lat") for tag in tags],
            lons=[tag.get("lon") for tag in tags],
            embeddings_BD=np.concatenate(blocks),
        )
        footer = PartFooter(
            fingerprint=self.network.fingerprint, shard_sha256=shard.sha256, rows=len(samples), rejected=tuple(rejected)
        )
        write_part(storage.join(self.settings.out, f"{shard.name}.parquet"), rows, footer, self.settings.dtype)


def embed_gallery(settings: EmbeddingSettings, network: Network) -> int:
    """Embed every shard that has no finished part yet; returns how many images were embedded.

    `settings` must name paths that a worker can open (absolute, or URIs). Raises InputError on unusable input.
    """
    manifest: Manifest = open_manifest(settings.shards, settings.split, settings.view)
    wanted = [shard for shard in manifest.of(settings.split, settings.view) if shard.samples]
    if not wanted:
        held = ", ".join(sorted({f"{shard.split} {shard.view}" for shard in manifest.shards})) or "nothing"
        raise InputError(f"{settings.shards} holds {held}, and none of it was asked for; check --split and --view")
    missing = [
        s for s in wanted if not is_done(storage.join(settings.out, f"{s.name}.parquet"), network.fingerprint, s)
    ]
    total = sum(shard.samples for shard in missing)
    if not missing:
        console.print(f"{settings.out} is complete: {len(wanted)} parts; nothing to do")
        return 0
    cluster.connect()
    gpus = cluster.gpus() if settings.gpus_per_worker else 0
    workers = min(len(missing), settings.workers or gpus or max(1, cluster.cpus() // 8))
    cpus = settings.cpus_per_worker or max(1, cluster.cpus() // workers)
    actor = ray.remote(num_cpus=cpus, num_gpus=settings.gpus_per_worker)(ShardEmbedder)
    spent, start = defaultdict[str, float](float), time.perf_counter()
    with progress(total, "embedding") as meter:
        actors = [actor.remote(settings, network, cpus) for _ in range(workers)]
        pool = ActorPool(actors)  # one call in flight per actor, the rest waits in the driver
        for shard, seconds in pool.map_unordered(lambda one, shard: one.embed.remote(shard), missing):
            for name, value in seconds.items():
                spent[name] += value
            meter.advance(shard.samples)
    for finished in actors:
        ray.kill(finished)  # type: ignore[arg-type]
    elapsed = time.perf_counter() - start
    spent["start and idle"] = max(0.0, workers * elapsed - sum(spent.values()))
    split = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in spent.items())
    console.print(f"{settings.out}: {total} images in {elapsed:.1f} s ({split}, over {workers} workers)")
    return total
