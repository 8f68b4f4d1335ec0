"""The worker of the embedding stage: holds the encoder and turns shard after shard into parts.

In: a shard. Out: its part, and where the seconds went. Threads beside the computing one read,
decode and write: while a shard is embedded, the next one's first batches are prefetched and the
last one's part is written.
Shapes: B images of a batch, H x W pixels, D dimensions of an embedding, N images of a shard.
"""

import errno
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import chain
from queue import SimpleQueue

import numpy as np
import numpy.typing as npt

from pipeline.batches.ordered import Decoded, decode_sample, stack
from pipeline.camera.local_plane import tile_side_m
from pipeline.core import storage
from pipeline.core.arrays import Floats, Halves, Pixels
from pipeline.core.errors import InputError
from pipeline.core.prefetch import prefetch, prefetch_map
from pipeline.core.records import Rejection
from pipeline.features.encoding import EncodingConfig
from pipeline.features.part import PartFooter, PartRows, vector_lengths, write_part
from pipeline.images.decode import DecodeError
from pipeline.shards.manifest import Shard
from pipeline.shards.samples import Sample
from pipeline.shards.shard_set import ShardSet

Encoder = Callable[[npt.NDArray[np.uint8]], Floats]
"""Images as bytes (B, 3, H, W) -> unit vectors (B, D), float32. Created and called by one thread.
An encoder may have `remarks`, a list of sentences to print once it is loaded."""
IN_FLIGHT = 2
"Shards that a worker has at once: one is embedded while the other is read, or written."
PREFETCH_BATCHES = 2
"Stacked and waiting for the encoder."
FATAL_WRITE_ERRORS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM})
"Errors of writing that the next shard would meet as well."
Seconds = defaultdict[str, float]


@dataclass(frozen=True, kw_only=True)
class EncoderSpec:
    """The encoder, as far as the embedding stage needs to know it."""

    fingerprint: str
    "Hash of weights, config and encoding."
    encoding: EncodingConfig
    "Recorded in the table. Its resizer brings images to `image_size`."
    image_size: int
    "Side in pixels of the images that it takes."
    factory: Callable[[int], Encoder]
    "Called once on each worker, with the number of threads that it may use."


@dataclass(frozen=True, kw_only=True)
class EmbedJob:
    """What the work on every shard has in common."""

    shards: ShardSet
    out: str
    batch_size: int
    dtype: str
    threads: int
    "That the encoder may use."
    decode_threads: int


@dataclass(frozen=True, kw_only=True)
class ShardResult:
    """A shard that was embedded."""

    rows: int
    rejected: tuple[Rejection, ...]
    seconds: dict[str, float]
    "Of threads, by what they did: read, decode, infer, write."


class TableWriteFailed(RuntimeError):
    """The table cannot be written to. The message is one sentence."""


class ShardEmbedder:
    """One worker. `work` may be called by two threads at once."""

    def __init__(self, job: EmbedJob, spec: EncoderSpec) -> None:
        self._job, self._spec = job, spec
        # One thread computes for all shards: they queue here, and torch's settings, which belong to
        # a thread, hold for every pass.
        self._device = ThreadPoolExecutor(1)
        # Threads for the worker's life, shared by the shards that it has at once.
        self._decoders = ThreadPoolExecutor(job.decode_threads)
        self._readers = SimpleQueue[ThreadPoolExecutor]()
        for _ in range(IN_FLIGHT):
            self._readers.put(ThreadPoolExecutor(1))
        self._encoder: Encoder
        self._dimension = 0

    def start(self) -> list[str]:
        """Load the encoder; returns its remarks."""
        self._encoder = self._device.submit(self._spec.factory, self._job.threads).result()
        return list(getattr(self._encoder, "remarks", ()))

    def work(self, shard: Shard) -> ShardResult:
        """Embed one shard and write its part.

        Raises InputError where the tar is truncated or differs from the manifest, TableWriteFailed
        where the table cannot be written to.
        """
        seconds, rejected, samples = Seconds(float), list[Rejection](), list[Sample]()
        batches_of_shard = self._batches(shard, samples, rejected, seconds)
        with (
            self._reader() as reader,
            closing(prefetch(batches_of_shard, PREFETCH_BATCHES, reader)) as batches,
        ):
            # Requested here, so that it is made while another shard is being embedded.
            first = next(batches, None)
            all_batches = chain([] if first is None else [first], batches)
            embeddings_ND = self._device.submit(
                self._infer, shard, samples, all_batches, seconds
            ).result()
        if len(samples) + len(rejected) != shard.samples:
            raise InputError(
                f"{self._job.shards.tar(shard)} holds "
                f"{len(samples) + len(rejected)} images, expected the {shard.samples} of the "
                "manifest; copy it again from where it came from, or pack again"
            )
        start = time.perf_counter()
        self._write(shard, samples, embeddings_ND[: len(samples)], rejected)
        seconds["write"] += time.perf_counter() - start
        return ShardResult(rows=len(samples), rejected=tuple(rejected), seconds=dict(seconds))

    @contextmanager
    def _reader(self) -> Iterator[ThreadPoolExecutor]:
        reader = self._readers.get()
        try:
            yield reader
        finally:
            self._readers.put(reader)

    def _batches(
        self, shard: Shard, kept: list[Sample], rejected: list[Rejection], seconds: Seconds
    ) -> Iterator[npt.NDArray[np.uint8]]:
        """Images (B, 3, H, W) of a shard by a webdataset pipeline. All batches but the last are
        full, however many images are rejected.
        """
        import webdataset as wds  # here, because it imports torch

        return iter(
            wds.DataPipeline(
                partial(self._job.shards.samples, shard, verify=True),
                partial(_timed, seconds),
                self._decode,
                partial(_keep_decoded, kept, rejected, seconds),
                wds.batched(self._job.batch_size, collation_fn=stack),
            )
        )

    def _decode(self, samples: Iterable[Sample]) -> Iterator[tuple[Decoded, float]]:
        return prefetch_map(self._decode_one, samples, self._decoders, self._job.batch_size)

    def _decode_one(self, sample: Sample) -> tuple[Decoded, float]:
        start = time.perf_counter()
        encoding = self._spec.encoding
        decoded = decode_sample(
            sample, self._spec.image_size, encoding.resizer, encoding.perspective
        )
        return decoded, time.perf_counter() - start

    def _infer(
        self,
        shard: Shard,
        kept: list[Sample],
        batches: Iterable[npt.NDArray[np.uint8]],
        seconds: Seconds,
    ) -> Floats | Halves:
        """Embeddings (N, D) in the table's dtype; rows beyond the decoded images are undefined."""
        embeddings_ND: Floats | Halves | None = None
        count = 0
        for images_B3HW in batches:
            start = time.perf_counter()
            embeddings_BD = self._encoder(images_B3HW)
            seconds["infer"] += time.perf_counter() - start
            _check_unit_length(embeddings_BD, kept[count:])
            if embeddings_ND is None:
                self._dimension = embeddings_BD.shape[1]
                embeddings_ND = np.empty((shard.samples, self._dimension), self._job.dtype)
            end = count + len(embeddings_BD)
            if end <= shard.samples:  # more images are refused when all have been counted
                embeddings_ND[count:end] = embeddings_BD
            count = end
        if embeddings_ND is not None:
            return embeddings_ND
        if not self._dimension:  # this worker's first shard has no image: it becomes a part anyway
            size = self._spec.image_size
            black_13HW = stack([np.zeros((size, size, 3), np.uint8)])
            self._dimension = self._encoder(black_13HW).shape[1]
        return np.empty((0, self._dimension), self._job.dtype)

    def _write(
        self,
        shard: Shard,
        samples: list[Sample],
        embeddings_ND: Floats | Halves,
        rejected: list[Rejection],
    ) -> None:
        tags = [sample.metadata["geotag"] or {} for sample in samples]
        rows = PartRows(
            keys=[sample.key for sample in samples],
            locations=[sample.metadata["location"] for sample in samples],
            views=[sample.metadata["view"] for sample in samples],
            splits=[sample.metadata["split"] for sample in samples],
            lats=[tag.get("lat") for tag in tags],
            lons=[tag.get("lon") for tag in tags],
            sides_m=[
                tile_side_m(tag["footprint"]) if tag.get("footprint") else None for tag in tags
            ],
            embeddings_BD=embeddings_ND,
        )
        footer = PartFooter(
            fingerprint=self._spec.fingerprint,
            shard_sha256=shard.sha256,
            rows=len(samples),
            rejected=tuple(rejected),
            encoding=self._spec.encoding,
        )
        path = storage.join(self._job.out, f"{shard.name}.parquet")
        try:
            write_part(path, rows, footer, self._job.dtype)
        except OSError as error:
            if error.errno not in FATAL_WRITE_ERRORS:
                raise
            raise TableWriteFailed(
                f"{path} cannot be written ({error.strerror}), expected "
                f"{embeddings_ND.nbytes / 1e6:.1f} MB of room and the right to write; make room or "
                "choose another --out, and run the same command again to resume"
            ) from None


def _check_unit_length(embeddings_BD: Floats, samples: list[Sample]) -> None:
    """Raise InputError where an encoder's output is NaN or not of unit length."""
    length_B, unit_B = vector_lengths(embeddings_BD)
    if not unit_B.all():
        worst = int(np.argmin(unit_B))
        raise InputError(
            f"the network gives {samples[worst].key} an embedding of length {length_B[worst]:.4g}, "
            "expected 1; check that image and the checkpoint"
        )


def _timed(seconds: Seconds, samples: Iterator[Sample]) -> Iterator[Sample]:
    """The same samples; the time that each took is counted as reading."""
    while True:
        start = time.perf_counter()
        sample = next(samples, None)
        seconds["read"] += time.perf_counter() - start
        if sample is None:
            return
        yield sample


def _keep_decoded(
    kept: list[Sample],
    rejected: list[Rejection],
    seconds: Seconds,
    images: Iterable[tuple[Decoded, float]],
) -> Iterator[Pixels]:
    """The pixels of the images that could be decoded. Their samples are added to `kept` without
    their bytes, the others to `rejected`.
    """
    for (sample, image), spent in images:
        seconds["decode"] += spent
        if isinstance(image, DecodeError):
            rejected.append(Rejection(path=sample.key, reason=image.reason, found=image.found))
            continue
        kept.append(Sample(key=sample.key, data=b"", metadata=sample.metadata))
        yield image
