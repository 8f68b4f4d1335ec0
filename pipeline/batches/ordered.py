"""TODO pipeline.batches.ordered."""

import hashlib
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import numpy.typing as npt

from pipeline.core.prefetch import prefetch_map
from pipeline.images.decode import DecodeError, Pixels, decode
from pipeline.images.transforms import Resizer, resize
from pipeline.shards.samples import Sample

Opened = tuple[Sample, Pixels | DecodeError]
"A sample and its pixels, or why there are none."
CHANGED = "changed since it was packed"


def refuse_changed(sample: Sample) -> None:
    """Raise DecodeError where an image is not the one that was packed: 25 us, where decoding takes
    a millisecond or more.
    """
    said = sample.facts.get("sha256")
    if said is not None and hashlib.sha256(sample.data).hexdigest() != said:
        raise DecodeError(CHANGED, "other bytes than were packed")


def stack(images_HW3: Sequence[Pixels]) -> npt.NDArray[np.uint8]:
    """Images of one size as (B, 3, H, W), channels last in memory, which is how the network wants
    them.
    """
    return np.stack(images_HW3).transpose(0, 3, 1, 2)


def decoded(
    samples: Iterable[Sample], image_size: int, threads: int, depth: int, resizer: Resizer = "torch"
) -> Iterator[Opened]:
    """The samples' images in order, decoded and resized by threads; what cannot be decoded comes as
    its error.
    """
    return prefetch_map(lambda sample: opened(sample, image_size, resizer), samples, threads, depth)


def opened(sample: Sample, image_size: int, resizer: Resizer = "torch") -> Opened:
    """One sample's image, decoded and resized, or why it cannot be."""
    try:
        refuse_changed(sample)
        return sample, resize(decode(sample.data), image_size, resizer)
    except DecodeError as error:
        return sample, error


def sound(images: Iterable[Opened]) -> tuple[list[tuple[Sample, Pixels]], list[str]]:
    """The images that could be decoded, and the keys of the others."""
    whole: list[tuple[Sample, Pixels]] = []
    damaged: list[str] = []
    for sample, image in images:
        if isinstance(image, DecodeError):
            damaged.append(sample.key)
        else:
            whole.append((sample, image))
    return whole, damaged
