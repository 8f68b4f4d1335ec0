"""The built-in encoder: how it was trained, how it is fine-tuned on places of your own, and what
would be trained by what the benchmark of methods found."""

from dataclasses import replace

from jobs.training.recipes.recipe import Recipe
from model.config import LossWeights, Optimization, PVDAConfig
from model.schedule import Schedule
from pipeline.images.augmentation import Augmentation


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


def best(epochs: int = 40) -> Recipe:
    """What gained most on SimU at an equal budget, together: docs/benchmark.md.

    Rings, Eq. 1 and InfoNCE in full, PVDA's warm restarts without its adversary, UAV images laid on
    the ground: for those whose pose is known. `epochs` are four periods, as PVDA's.
    """
    terms = builtin()
    return replace(
        terms,
        name="best",
        network=replace(terms.network, ring_divisor="box", dropout=0.75),
        losses=LossWeights(contrastive_weight=1.0),
        schedule=Schedule(alpha=0.0, alpha_step=0.0).scaled_to(epochs),
        perspective="overhead",
    )


def finetune(epochs: int = 8) -> Recipe:
    """The built-in encoder on places of your own: minutes on two cores, at a third of the rates."""
    recipe = builtin(epochs)
    rates = replace(recipe.optimization, backbone_lr=1e-4, head_lr=3e-4)
    return replace(recipe, name="finetune", start="builtin", optimization=rates)
