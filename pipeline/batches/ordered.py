"""Samples -> decoded images in their order, for embedding and for looking at them.

In: samples. Out: each with its pixels, or with the reason why it has none.
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import numpy.typing as npt

from pipeline.camera.overhead import overhead_view
from pipeline.camera.pose import Perspective
from pipeline.core.arrays import Pixels
from pipeline.core.integrity import sha256_of
from pipeline.core.prefetch import prefetch_map
from pipeline.core.records import View
from pipeline.images.decode import DecodeError, decode
from pipeline.images.transforms import Resizer, resize
from pipeline.shards.samples import Sample

Decoded = tuple[Sample, Pixels | DecodeError]
"A sample and its pixels, or the reason why it has none."
CHANGED = "changed since it was packed"


def check_unchanged(sample: Sample) -> None:
    """Raise DecodeError where an image is not the one that was packed: 25 us, where decoding takes
    a millisecond or more.
    """
    packed = sample.metadata.get("sha256")
    if packed is not None and sha256_of(sample.data) != packed:
        raise DecodeError(CHANGED, "other bytes than were packed")


def stack(images_HW3: Sequence[Pixels]) -> npt.NDArray[np.uint8]:
    """Images of one size as (B, 3, H, W), channels last in memory, the layout that the network is
    fastest with.
    """
    return np.stack(images_HW3).transpose(0, 3, 1, 2)


def open_image(sample: Sample, perspective: Perspective = "as_taken") -> Pixels:
    """A sample's pixels, (H, W, 3), of UAV images in this perspective. Raises DecodeError."""
    check_unchanged(sample)
    image_HW3 = decode(sample.data)
    if perspective == "overhead" and sample.metadata["view"] == View.DRONE:
        return overhead_view(image_HW3, sample.metadata["geotag"])
    return image_HW3


def decode_samples(
    samples: Iterable[Sample],
    image_size: int,
    threads: int,
    depth: int,
    resizer: Resizer = "torch",
    perspective: Perspective = "as_taken",
) -> Iterator[Decoded]:
    """The samples' images in order, decoded and resized by threads that prefetch `depth` of them;
    an image that cannot be decoded is returned as its error.
    """
    return prefetch_map(
        lambda sample: decode_sample(sample, image_size, resizer, perspective),
        samples,
        threads,
        depth,
    )


def decode_sample(
    sample: Sample,
    image_size: int,
    resizer: Resizer = "torch",
    perspective: Perspective = "as_taken",
) -> Decoded:
    """One sample's image, decoded and resized, or why it cannot be."""
    try:
        return sample, resize(open_image(sample, perspective), image_size, resizer)
    except DecodeError as error:
        return sample, error


def is_damaged(one: Decoded) -> bool:
    """Whether an image could not be decoded."""
    return isinstance(one[1], DecodeError)


def split_failed(images: Iterable[Decoded]) -> tuple[list[tuple[Sample, Pixels]], list[str]]:
    """The images that could be decoded, and the keys of the others."""
    intact: list[tuple[Sample, Pixels]] = []
    damaged: list[str] = []
    for sample, image in images:
        if isinstance(image, DecodeError):
            damaged.append(sample.key)
        else:
            intact.append((sample, image))
    return intact, damaged
