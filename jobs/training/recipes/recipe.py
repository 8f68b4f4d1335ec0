"""A recipe: all settings of a training's computation.

In: nothing. Out: a frozen dataclass, which the command line shows as flags. Each method is a file
beside this one.
"""

from dataclasses import dataclass, field

from model.config import LossWeights, Optimization, Precision, PVDAConfig, Start
from model.schedule import Schedule
from pipeline.batches.settings import Sampler, check_sampler
from pipeline.camera.pose import Perspective
from pipeline.core.errors import require
from pipeline.images.augmentation import Augmentation
from pipeline.images.transforms import Resizer


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """All settings of training's computation, besides the data and the number of workers."""

    name: str = "paper"
    "Name of the recipe."
    network: PVDAConfig = field(default_factory=PVDAConfig)
    start: Start = "random"
    """Weights before the first step: random; imagenet, from an installed package; or those of the
    built-in encoder. A file of --weights goes before it."""
    losses: LossWeights = field(default_factory=LossWeights)
    optimization: Optimization = field(default_factory=Optimization)
    schedule: Schedule = field(default_factory=Schedule)
    augmentation: Augmentation = field(default_factory=Augmentation)
    resizer: Resizer = "torch"
    """Whose bicubic resizes the images: torch's, or pillow's, which is faster on CPUs without AVX2
    [chosen]."""
    perspective: Perspective = "as_taken"
    """How UAV images are seen, in training and where the encoder embeds: as they were taken, or
    laid on the ground north up where the shards have the camera's pose [PCL]."""
    adversary: bool = True
    "Train with a view discriminator; without it PVDA is LPN."
    sampler: Sampler = "independent"
    """How a step's images are drawn: each view by itself, as pairs of distinct locations, or as
    pairs of which an epoch has each location `pair_repeats` times [LPN lineage: independent]."""
    pair_repeats: int = 1
    "Pairs of each location in an epoch of the sampler `paired` [FSRA: 1 or 3]."
    batch_size: int = 8
    "Images of each view per step and worker [LPN lineage: 8]."
    seed: int = 0
    "Seed of the weights, the order of the data and the augmentation."
    precision: Precision = "auto"
    """Precision of the networks' products: float32, bfloat16 by autocast, or auto: bfloat16 on
    CUDA, float32 on a CPU [chosen]."""
    sync_bn: bool = False
    """BatchNorm's statistics are those of all workers' images; GPUs only [chosen: each worker's
    own]."""
    joint_bn: bool = False
    """The encoder gets both views in one batch, so that BatchNorm's statistics are common to them
    [LPN: a view's own; where the views' sensors differ much, training then never runs the network
    as it is used, with common statistics]."""
    hold_out: float = 0.0
    """Share of the training locations that is held out, and probed every `probe_epochs` [chosen:
    none]."""
    pseudo_neighbours: int = 0
    """Train without the shards' labels: every `period` epochs a UAV image is paired anew with its
    nearest satellite image where it is among the so many UAV images nearest to that one. 0: train
    with the labels."""
    pseudo_margin: float = 0.0
    """And where that satellite image's cosine is at least so much above the second nearest's
    [chosen: any]."""

    def __post_init__(self) -> None:
        few = "at least 2: BatchNorm needs two images of a view"
        require(self.batch_size >= 2, "batch_size", self.batch_size, few)
        pairs = "unique_pairs, or paired with each location once, since InfoNCE compares rows"
        distinct = self.sampler == "unique_pairs" or (
            self.sampler == "paired" and self.pair_repeats == 1
        )
        require(not self.losses.contrastive_weight or distinct, "sampler", self.sampler, pairs)
        rows = "unique_pairs or paired, since a loss compares the views row by row"
        aligned = self.sampler != "independent"
        require(not self.losses.needs_pairs or aligned, "sampler", self.sampler, rows)
        check_sampler(self.sampler, self.pair_repeats, self.augmentation)
        share = "a share of the locations, from 0 to below 1"
        require(0 <= self.hold_out < 1, "hold_out", self.hold_out, share)
        few = "0 (the shards' labels) or more"
        require(self.pseudo_neighbours >= 0, "pseudo_neighbours", self.pseudo_neighbours, few)
        require(0 <= self.pseudo_margin <= 2, "pseudo_margin", self.pseudo_margin, "0 to 2")
        if self.pseudo_neighbours:
            every = "unique_pairs or independent: not every satellite image gets a pseudo-label"
            require(self.sampler != "paired", "sampler", self.sampler, every)
            none = "0 with --pseudo-neighbours, which knows no locations"
            require(self.hold_out == 0, "hold_out", self.hold_out, none)
