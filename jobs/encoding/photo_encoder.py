"""Photos as bytes -> embeddings that an index can be asked with: the network and the settings that
the index was made by.

In: a checkpoint's bytes, and what an index says of itself. Out: a PhotoEncoder. No one has to
repeat with which resizer or in which precision the gallery was embedded: the index's fingerprint
says which of all possible settings it was.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import torch

from jobs.encoding.encoder import CALIBRATION_IMAGES, PROBE_IMAGES, Bytes, first_images
from model.checkpoint import Checkpoint, build_encoder, fingerprint, loads
from model.inference.int8 import calibration_digest, require_int8
from model.inference.optimise import optimise_encoder
from model.inference.precision import EffectivePrecision, describe_preprocessing
from pipeline.batches.ordered import stack
from pipeline.core.arrays import Pixels
from pipeline.core.errors import InputError
from pipeline.core.prefetch import prefetch_map
from pipeline.core.records import Rejection
from pipeline.features.table import Floats
from pipeline.images.decode import DecodeError, decode
from pipeline.images.inspect import inspect
from pipeline.images.transforms import Resizer, preprocessing_name, resize
from pipeline.shards.shard_set import open_or_scan

FORWARD_BATCH = 32
"Photos of a forward pass."
DECODE_THREADS = 2
"That decode; the network computes on all cores."


@dataclass(frozen=True, kw_only=True)
class EncodingConfig:
    """One way to embed with a network."""

    mirror: bool
    resizer: Resizer
    precision: EffectivePrecision
    probe_B3HW: Bytes
    "Images to check the encoder by."
    calibration_B3HW: Bytes | None = None

    def fingerprint(self, checkpoint: Checkpoint) -> str:
        calibration = self.calibration_B3HW
        digest = None if calibration is None else calibration_digest(torch.from_numpy(calibration))
        said = f"{preprocessing_name(self.resizer)}, mirror {self.mirror}"
        return fingerprint(checkpoint, describe_preprocessing(said, self.precision, digest))


class PhotoEncoder:
    """The encoder that made an index's embeddings, for photos that come one by one or by the
    hundred.

    Not for several threads at once: torch spreads a batch over the cores itself.
    """

    def __init__(
        self, checkpoint: bytes, name: str, index_facts: dict[str, Any], shards: str | None = None
    ) -> None:
        """`checkpoint` are the bytes of the file `name`, `index_facts` those of Index.facts.

        `shards` are those that the index was made of: needed only where its embeddings are int8,
        which they calibrated. Raises CheckpointError when the bytes are no checkpoint, InputError
        when they did not make the index.
        """
        opened = loads(checkpoint, name)
        self.image_size = opened.network.image_size
        self.fingerprint: str = index_facts["fingerprint"]
        ways = candidate_configs(shards, self.image_size)
        way = next((way for way in ways if way.fingerprint(opened) == self.fingerprint), None)
        if way is None:
            int8 = (
                ""
                if shards
                else ", or, where it was embedded in int8, give the --shards that it was made of"
            )
            raise InputError(
                f"{name} did not make this index: none of its fingerprints is "
                f"{self.fingerprint[:12]}..., expected the "
                f"checkpoint that the gallery was embedded with; name that one{int8}"
            )
        self.precision: EffectivePrecision = way.precision
        self.remarks: list[str] = []
        "What the encoder's check had to say."
        self._resizer: Resizer = way.resizer
        device = "cuda" if torch.cuda.is_available() else "cpu"
        if way.precision == "int8":
            require_int8(device)
        encoder = build_encoder(opened).to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        calibration = way.calibration_B3HW
        self._encode = optimise_encoder(
            encoder,
            probe_B3HW=torch.from_numpy(way.probe_B3HW),
            batch_size=FORWARD_BATCH,
            precision=way.precision,
            mirror=way.mirror,
            compiled=False,  # compiling takes longer than some hundred photos
            calibration_B3HW=None if calibration is None else torch.from_numpy(calibration),
            log=self.remarks.append,
        )
        self.dimension = opened.network.embedding_dim

    def encode(
        self, photos: Sequence[bytes], names: Sequence[str] | None = None
    ) -> tuple[Floats, list[Rejection | None]]:
        """Unit embeddings (Q, D) of the photos that can be decoded, in order, and for each photo
        None or why it has no row.

        `names` are what a rejection's path says; by default the photos' numbers, from 1.
        """
        named = names or [f"photo {number}" for number in range(1, len(photos) + 1)]
        opened = (
            list(prefetch_map(self._open, photos, DECODE_THREADS, 4 * DECODE_THREADS))
            if len(photos) > 1
            else [*map(self._open, photos)]
        )
        rejected = [
            Rejection(path=name, reason=image.reason, found=image.found)
            if isinstance(image, DecodeError)
            else None
            for name, image in zip(named, opened, strict=True)
        ]
        whole = [image for image in opened if not isinstance(image, DecodeError)]
        if not whole:
            return np.empty((0, self.dimension), np.float32), rejected
        return self._encode(torch.from_numpy(stack(whole))).cpu().numpy(), rejected

    def _open(self, data: bytes) -> Pixels | DecodeError:
        """Judged by its structure first, so that no bomb and no strip is decoded."""
        try:
            inspect(data)
            return resize(decode(data), self.image_size, self._resizer)
        except DecodeError as error:
            return error


def candidate_configs(shards: str | None, size: int) -> Iterator[EncodingConfig]:
    """All ways to embed, the likely ones first."""
    precisions: tuple[EffectivePrecision, ...] = ("float32", "bfloat16")
    resizers: tuple[Resizer, ...] = ("torch", "pillow")
    made_B3HW = synthetic_images(size)
    for precision, mirror, resizer in product(precisions, (True, False), resizers):
        yield EncodingConfig(
            mirror=mirror, resizer=resizer, precision=precision, probe_B3HW=made_B3HW
        )
    if shards is None:
        return
    opened = open_or_scan(shards)
    for resizer, mirror in product(resizers, (True, False)):
        some_B3HW = first_images(opened, size, resizer, PROBE_IMAGES + CALIBRATION_IMAGES)
        yield EncodingConfig(
            mirror=mirror,
            resizer=resizer,
            precision="int8",
            probe_B3HW=some_B3HW[:PROBE_IMAGES],
            calibration_B3HW=some_B3HW[PROBE_IMAGES:],
        )


def synthetic_images(size: int) -> Bytes:
    """Images (PROBES, 3, size, size) to check the encoder by before any photo is there: clouds of
    colour, always the same.
    """
    rng = np.random.default_rng(0)
    sides = [4 << number % 4 for number in range(PROBE_IMAGES)]
    return stack(
        [resize(rng.integers(0, 256, size=(side, side, 3), dtype=np.uint8), size) for side in sides]
    )
