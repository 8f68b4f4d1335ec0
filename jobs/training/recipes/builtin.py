"""The built-in encoder: how it was trained, the same for UAV images of known pose, and how it is
fine-tuned on places of your own."""

from dataclasses import replace

from jobs.training.recipes.recipe import Recipe
from model.config import LossWeights, Optimization, PVDAConfig
from model.schedule import Schedule
from pipeline.images.augmentation import Augmentation


def builtin(epochs: int = 46) -> Recipe:
    """The built-in encoder's: EfficientNet-Lite0 from ImageNet, what gained most on SimU, together.

    Rings, Eq. 1 and InfoNCE in full on pairs of distinct places, PVDA's warm restarts without its
    adversary, which gained nothing (docs/benchmark.md). Of 46 `epochs` 40 are four periods, as
    PVDA's, and in six the rates fall to zero. An hour on two cores where the paper's ResNet-50
    takes days. Rates and sizes are chosen.
    """
    return Recipe(
        name="builtin",
        network=PVDAConfig(
            backbone="efficientnet_lite0", image_size=128, part_dim=256,
            discriminator_channels=64,
        ),
        start="imagenet",
        losses=LossWeights(contrastive_weight=1.0),
        optimization=Optimization(
            optimizer="adamw", backbone_lr=3e-4, head_lr=1e-3, classifier_lr=1e-3,
            discriminator_lr=1e-3, weight_decay=0.01, frozen_stages=4,
        ),
        schedule=Schedule(
            epochs=46, alpha=0.0, alpha_step=0.0, period=10, decay_epochs=(4, 9), cool_down_epochs=6
        ).scaled_to(epochs),
        augmentation=Augmentation(
            pad=0, rotation=180, mirror=False, affine=True, drone_rotation=10, scale=0.2,
            shift=0.08, colour=1.0, blur=0.8, noise=8.0, jpeg=0.3, hide=0.2,
        ),
        adversary=False,
        sampler="unique_pairs",
        batch_size=24,
        joint_bn=True,
    )  # fmt: skip


def best(epochs: int = 46) -> Recipe:
    """`builtin` with UAV images laid on the ground: for those whose pose is known."""
    return replace(builtin(epochs), name="best", perspective="overhead")


def finetune(epochs: int = 8) -> Recipe:
    """The built-in encoder on places of your own: minutes on two cores, at a third of the rates.

    One cosine, and a tenth of Eq. 1: its classifier begins anew and has little time.
    """
    recipe = builtin(epochs)
    return replace(
        recipe,
        name="finetune",
        network=replace(recipe.network, dropout=0.0),
        start="builtin",
        losses=LossWeights(contrastive_weight=1.0, location_weight=0.1),
        optimization=replace(recipe.optimization, backbone_lr=1e-4, head_lr=3e-4),
        schedule=Schedule(
            epochs=epochs, lr_schedule="cosine", warmup_epochs=1, alpha=0.1, alpha_step=0.0
        ),
    )
