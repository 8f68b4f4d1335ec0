"""How training images are read. Imports nothing heavy: a recipe carries these words."""

from dataclasses import dataclass, field
from typing import Literal

from pipeline.camera.pose import Perspective
from pipeline.core.errors import InputError, require
from pipeline.images.augmentation import Augmentation
from pipeline.images.transforms import Resizer

Sampler = Literal["independent", "unique_pairs", "paired"]
"""How a step's images are drawn. `independent`: each view by itself [LPN]. `unique_pairs`: row by
row the two views of one location, each location once in a batch; the UAV images choose the
locations, so an epoch has some several times and others not at all [Sample4Geo]. `paired`: row by
row too, and an epoch has each location exactly `pair_repeats` times, in neighbouring rows, less the
last partial batch [FSRA]."""


def check_sampler(sampler: Sampler, pair_repeats: int, augmentation: Augmentation) -> None:
    """Raises InputError where a setting has no effect with the sampler, or no meaning."""
    require(pair_repeats >= 1, "pair_repeats", pair_repeats, "1 or more")
    if pair_repeats > 1 and sampler != "paired":
        raise InputError(
            f"found --pair-repeats {pair_repeats} with --sampler {sampler}, expected --sampler "
            "paired, the only one that repeats locations; change one of the two"
        )
    if augmentation.pair_mirror and sampler == "independent":
        raise InputError(
            "found --pair-mirror with --sampler independent, which draws no pairs, expected "
            "--sampler paired or unique_pairs; change one of the two"
        )


@dataclass(frozen=True, kw_only=True)
class StreamConfig:
    """How training images are read."""

    batch_size: int = 8
    "Images of each view per step and worker [LPN lineage: 8]."
    image_size: int = 256
    "Side in pixels of the network's input."
    resizer: Resizer = "torch"
    "Whose bicubic resizes images to it."
    perspective: Perspective = "as_taken"
    "How UAV images are seen before they are resized."
    augmentation: Augmentation = field(default_factory=Augmentation)
    seed: int = 0
    shuffle_buffer: int = 4096
    "Encoded images buffered for shuffling; those of University-1652 take some 40 kB each."
    keep_bytes: int = 2**28
    "Of shards that stay in memory from epoch to epoch, with their decoded images."
    threads: int = 2
    "Threads that decode and augment ahead of the network."
    hold_out: float = 0.0
    "Share of the locations that is left out: `held_out` of the stream."
    sampler: Sampler = "independent"
    "How the images of a step are drawn from the two views."
    pair_repeats: int = 1
    """Rows that each location gets in an epoch of `paired`, with one satellite image and one UAV
    image each [FSRA: 1, and 3 in its best row]."""

    def __post_init__(self) -> None:
        check_sampler(self.sampler, self.pair_repeats, self.augmentation)
