"""Images by which an encoder is checked before use, and by which int8 is calibrated.

In: a set of shards, or nothing. Out: images as bytes (B, 3, H, W). Those of shards are chosen by
their position in the shards alone, so a resumed run has the same ones.
"""

from itertools import islice

import numpy as np
import numpy.typing as npt

from pipeline.batches.ordered import CHANGED, decode_samples, stack
from pipeline.camera.pose import Perspective
from pipeline.core.arrays import Pixels
from pipeline.core.errors import InputError
from pipeline.images.decode import DecodeError
from pipeline.images.transforms import Resizer, resize
from pipeline.shards.samples import Sample
from pipeline.shards.shard_set import ShardSet

PROBE_IMAGES, CALIBRATION_IMAGES = 16, 128
"Images by which the fast encoder is checked, and by which int8 is calibrated."
CLOUD_SIDES = (4, 8, 16, 32)
"Cells a side of the synthetic ones: few, for the check may take longer than a photo's answer."
ImageBytes = npt.NDArray[np.uint8]


def first_images(
    shards: ShardSet,
    size: int,
    resizer: Resizer,
    count: int,
    perspective: Perspective = "as_taken",
) -> ImageBytes:
    """The first images of a set, alternately of each split and view, (at most `count`, 3, size,
    size).

    They are of the whole set, whatever part of it is to be embedded: queries and gallery may be
    embedded one after the other into one table. A shard's images are ordered by the hashes of their
    keys, so the first ones are a fair sample. Raises InputError where none of them can be decoded,
    or one has changed since it was packed.
    """
    first_shards = {
        (shard.split, shard.view): shard
        for shard in reversed(shards.manifest.shards)
        if shard.samples
    }
    shards.require_tars(first_shards.values())
    of_each = -(-count // len(first_shards))
    groups = []
    for shard in first_shards.values():
        decoded = decode_samples(shards.samples(shard), size, 1, 4, resizer, perspective)
        images = (usable_pixels(shards, *one) for one in decoded)
        groups.append(list(islice((one for one in images if one is not None), of_each)))
    mixed = [group[rank] for rank in range(of_each) for group in groups if rank < len(group)]
    if not mixed:
        raise InputError(
            f"none of the first images of {shards.path} can be decoded, expected some to check the "
            "encoder by; see make_shards.py --verify, and pack again"
        )
    return stack(mixed[:count])


def usable_pixels(shards: ShardSet, sample: Sample, image: Pixels | DecodeError) -> Pixels | None:
    """An image's pixels; None where it cannot be decoded. Raises InputError where it has changed
    since it was packed.
    """
    if isinstance(image, DecodeError) and image.reason == CHANGED:
        raise InputError(
            f"image {sample.key} of {shards.path} is not the one that was packed, expected it to "
            f"check the encoder by; {shards.repair_hint}"
        )
    return None if isinstance(image, DecodeError) else image


def synthetic_images(size: int) -> ImageBytes:
    """Images (4, 3, size, size) where no shards are at hand: clouds of colour of CLOUD_SIDES, the
    same every time.
    """
    rng = np.random.default_rng(0)
    noise = (rng.integers(0, 256, size=(side, side, 3), dtype=np.uint8) for side in CLOUD_SIDES)
    return stack([resize(image_HW3, size) for image_HW3 in noise])
