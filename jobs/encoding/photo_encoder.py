"""Encodes photos as an index's gallery was encoded: the same network, the same encoding; in float32
where the gallery is in 8-bit integers.

In: a checkpoint's bytes, and fingerprint and encoding from the index's metadata. Out: a
PhotoEncoder, whose embeddings the index can be searched with; no setting has to be repeated.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from jobs.encoding.encoder import encoder_fingerprint
from jobs.encoding.probe_images import synthetic_images
from model.checkpoint import build_encoder, loads
from model.inference.optimise import optimise_encoder
from pipeline.batches.ordered import stack
from pipeline.camera.overhead import overhead_view
from pipeline.camera.pose import Perspective
from pipeline.core.arrays import Floats, Pixels
from pipeline.core.errors import InputError
from pipeline.core.prefetch import prefetch_map
from pipeline.core.records import Rejection
from pipeline.features.encoding import EncodingConfig
from pipeline.images.decode import DecodeError, decode
from pipeline.images.inspect import inspect
from pipeline.images.transforms import resize

FORWARD_BATCH = 32
"Photos per forward pass."
DECODE_THREADS = 2
"The network computes on all cores beside them."


class PhotoEncoder:
    """The encoder that made an index's embeddings, for single photos or hundreds of them.

    Not thread-safe: torch spreads a batch over the cores itself.
    """

    def __init__(
        self,
        checkpoint: bytes,
        name: str,
        fingerprint: str,
        encoding: EncodingConfig | None,
        images: int | None = None,
    ) -> None:
        """`checkpoint`: the bytes of the file `name`. `fingerprint`, `encoding`: of the index.
        `images`: that it will encode, about; a compiler is asked where it pays for so many.

        Raises CheckpointError when the bytes are no checkpoint, InputError when they did not make
        the index.
        """
        opened = loads(checkpoint, name)
        if encoding is None:
            raise InputError(
                f"the index was built of features that another program made, which {name} cannot "
                "encode photos for; expected an index of a table of jobs/embed_gallery.py"
            )
        found = encoder_fingerprint(opened, encoding)
        if found != fingerprint:
            raise InputError(
                f"{name} did not make this index: its fingerprint is {found[:12]} and the index's "
                f"{fingerprint[:12]}, expected the checkpoint that the gallery was embedded with; "
                "name that one"
            )
        self.fingerprint, self.encoding = fingerprint, encoding
        self.image_size = opened.network.image_size
        self.dimension = opened.network.embedding_dim
        self.remarks: list[str] = []
        "What the check of the encoder found."
        device = "cuda" if torch.cuda.is_available() else "cpu"
        encoder = build_encoder(opened).to(  # type: ignore[call-overload]
            device, memory_format=torch.channels_last
        )
        self._encode = optimise_encoder(
            encoder,
            probe_B3HW=torch.from_numpy(synthetic_images(self.image_size)),
            batch_size=FORWARD_BATCH,
            # Finer is no worse (docs/results.md), and needs no VNNI and no images of the gallery.
            precision="float32" if encoding.precision == "int8" else encoding.precision,
            mirror=encoding.mirror,
            images=images,
            log=self.remarks.append,
        )

    def encode(
        self,
        photos: Sequence[bytes],
        names: Sequence[str] | None = None,
        geotags: Sequence[Mapping[str, Any] | None] | None = None,
    ) -> tuple[Floats, list[Rejection | None]]:
        """Unit embeddings (Q, D) of the photos that can be decoded, in order, and for each photo
        None or why it has no row.

        `names` become the rejections' paths; by default the photos' numbers, from 1. `geotags`: of
        UAV images, by which an encoder of the perspective `overhead` sees them.
        """
        names = names or [f"photo {number}" for number in range(1, len(photos) + 1)]
        images: list[Pixels | DecodeError]
        tagged = list(zip(photos, geotags or [None] * len(photos), strict=True))
        if len(photos) > 1:
            images = list(prefetch_map(self._decode, tagged, DECODE_THREADS, 4 * DECODE_THREADS))
        else:
            images = [*map(self._decode, tagged)]
        rejected = [
            Rejection(path=name, reason=image.reason, found=image.found)
            if isinstance(image, DecodeError)
            else None
            for name, image in zip(names, images, strict=True)
        ]
        return self.forward(
            [image for image in images if not isinstance(image, DecodeError)]
        ), rejected

    def forward(self, images: Sequence[Pixels]) -> Floats:
        """Unit embeddings (B, D) of images of the network's size."""
        if not images:
            return np.empty((0, self.dimension), np.float32)
        return self._encode(torch.from_numpy(stack(images))).cpu().numpy()

    @property
    def perspective(self) -> Perspective:
        """How UAV images are seen."""
        return self.encoding.perspective

    def to_input(self, image_HW3: Pixels) -> Pixels:
        """Pixels at the network's size."""
        return resize(image_HW3, self.image_size, self.encoding.resizer)

    def _decode(self, tagged: tuple[bytes, Mapping[str, Any] | None]) -> Pixels | DecodeError:
        data, geotag = tagged
        try:
            photo_HW3 = decode_photo(data)
            if self.perspective == "overhead":
                photo_HW3 = overhead_view(photo_HW3, geotag)
            return self.to_input(photo_HW3)
        except DecodeError as error:
            return error


def decode_photo(data: bytes) -> Pixels:
    """A photo's pixels. Its structure is inspected first, so that no decompression bomb is decoded.

    Raises DecodeError.
    """
    inspect(data)
    return decode(data)
