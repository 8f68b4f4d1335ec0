"""How training images are read. Imports nothing heavy: a recipe carries these words."""

from dataclasses import dataclass, field
from typing import Literal

from pipeline.images.augmentation import Augmentation
from pipeline.images.transforms import Resizer

Sampler = Literal["independent", "unique_pairs"]
"""How a step's images are drawn. `independent`: each view by itself [LPN]. `unique_pairs`: row by
row the two views of one location, each location once in a batch [Sample4Geo]."""


@dataclass(frozen=True, kw_only=True)
class StreamConfig:
    """How training images are read."""

    batch_size: int = 8
    "Images of each view per step and worker [LPN lineage: 8]."
    image_size: int = 256
    "Side in pixels of the network's input."
    resizer: Resizer = "torch"
    "Whose bicubic resizes images to it."
    augmentation: Augmentation = field(default_factory=Augmentation)
    seed: int = 0
    shuffle_buffer: int = 4096
    "Encoded images buffered for shuffling; those of University-1652 take some 40 kB each."
    threads: int = 2
    "Threads that decode and augment ahead of the network."
    hold_out: float = 0.0
    "Share of the locations that is left out: `held_out` of the stream."
    sampler: Sampler = "independent"
    "How the images of a step are drawn from the two views."
