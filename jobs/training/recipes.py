"""Named configurations, as functions that return a full config."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from model.config import LossWeights, Optimization, Precision, PVDAConfig, Start
from model.schedule import Schedule
from pipeline.batches.settings import Sampler, check_sampler
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

    def __post_init__(self) -> None:
        few = "at least 2: BatchNorm needs two images of a view"
        require(self.batch_size >= 2, "batch_size", self.batch_size, few)
        pairs = "unique_pairs, since InfoNCE compares the views row by row"
        distinct = self.sampler == "unique_pairs" or (
            self.sampler == "paired" and self.pair_repeats == 1
        )
        require(
            not self.losses.contrastive_weight or distinct,
            "sampler", self.sampler, pairs,
        )  # fmt: skip
        check_sampler(self.sampler, self.pair_repeats, self.augmentation)
        share = "a share of the locations, from 0 to below 1"
        require(0 <= self.hold_out < 1, "hold_out", self.hold_out, share)


def paper() -> Recipe:
    """PVDA at 256 px, as published."""
    return Recipe()


def paper_384() -> Recipe:
    """PVDA at 384 px, as published: nothing else changes [paper]."""
    return Recipe(name="paper_384", network=PVDAConfig(image_size=384))


def lpn() -> Recipe:
    """LPN at 256 px: no discriminator, its own 120 epochs with rates to a tenth after 80 [LPN].

    The views are PVDA's two; LPN's own runs on University-1652 add street-view images through a
    second backbone.
    """
    return Recipe(
        name="lpn",
        optimization=Optimization(backbone_lr=0.001, head_lr=0.01, classifier_lr=0.01),
        schedule=Schedule(
            epochs=120,
            alpha=0.0,
            alpha_step=0.0,
            period=120,
            decay=0.1,
            decay_epochs=(80,),
            restart=False,
        ),
        adversary=False,
    )


def constant_alpha() -> Recipe:
    """Ablation: alpha stays 0.9, the rates restart as in `paper` [paper]."""
    return Recipe(name="constant_alpha", schedule=Schedule(alpha_step=0.0))


def no_restart() -> Recipe:
    """Ablation: alpha grows as in `paper`, the rates only fall, by 0.8 at 140, 280, 420 [paper]."""
    return Recipe(name="no_restart", schedule=Schedule(restart=False, decay_epochs=(140, 280, 420)))


def alpha_zero() -> Recipe:
    """Control: `paper` with alpha = 0: D learns, nothing makes the encoder deceive it [chosen]."""
    return Recipe(name="alpha_zero", schedule=Schedule(alpha=0.0, alpha_step=0.0))


def smoke(epochs: int = 80) -> Recipe:
    """Minutes on two cores, from scratch: a thin ResNet-18, AdamW, one cosine, a gentle adversary.

    The paper's rates suppose ImageNet weights and days of training; from scratch they learn nothing
    in minutes. It stays the two-step method on the same code.
    """
    return Recipe(
        name="smoke",
        network=PVDAConfig(
            backbone="resnet18",
            width=0.25,
            image_size=64,
            parts=2,
            part_dim=128,
            dropout=0.0,
            discriminator_channels=64,
        ),
        optimization=Optimization(
            optimizer="adamw",
            backbone_lr=3e-3,
            head_lr=3e-3,
            classifier_lr=3e-3,
            discriminator_lr=1e-3,
        ),
        schedule=Schedule(
            epochs=epochs, lr_schedule="cosine", warmup_epochs=4, alpha=0.1, alpha_step=0.0
        ),
        augmentation=Augmentation(pad=4, rotation=180),
        batch_size=16,
    )


def builtin(epochs: int = 40) -> Recipe:
    """The built-in encoder's: EfficientNet-Lite0 from ImageNet, InfoNCE on pairs beside Eq. 1.

    An hour on two cores where the paper's ResNet-50 takes days. Rates, sizes and losses are chosen.
    No adversary: with one, R@1 on places of other imagery was the same (docs/results.md).
    """
    return Recipe(
        name="builtin",
        network=PVDAConfig(
            backbone="efficientnet_lite0", image_size=128, part_dim=256, dropout=0.0,
            ring_divisor="ring", discriminator_channels=64,
        ),
        start="imagenet",
        losses=LossWeights(contrastive_weight=1.0, location_weight=0.1),
        optimization=Optimization(
            optimizer="adamw", backbone_lr=3e-4, head_lr=1e-3, classifier_lr=1e-3,
            discriminator_lr=1e-3, weight_decay=0.01, frozen_stages=4,
        ),
        schedule=Schedule(
            epochs=epochs, lr_schedule="cosine", warmup_epochs=1, alpha=0.1, alpha_step=0.0
        ),
        augmentation=Augmentation(
            pad=0, rotation=180, mirror=False, affine=True, drone_rotation=10, scale=0.2,
            shift=0.08, colour=1.0, blur=0.8, noise=8.0, jpeg=0.3, hide=0.2,
        ),
        adversary=False,
        sampler="unique_pairs",
        batch_size=24,
        joint_bn=True,
    )  # fmt: skip


def finetune(epochs: int = 8) -> Recipe:
    """The built-in encoder on places of your own: minutes on two cores, at a third of the rates."""
    recipe = builtin(epochs)
    rates = replace(recipe.optimization, backbone_lr=1e-4, head_lr=3e-4)
    return replace(recipe, name="finetune", start="builtin", optimization=rates)


RECIPES: dict[str, Callable[[], Recipe]] = {
    recipe.__name__: recipe
    for recipe in (
        paper,
        paper_384,
        lpn,
        constant_alpha,
        no_restart,
        alpha_zero,
        smoke,
        builtin,
        finetune,
    )
}
