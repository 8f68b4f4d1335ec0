"""PVDA (arXiv 2401.01573): the paper's runs, its ablations and control, and a run of minutes."""

from jobs.training.recipes.recipe import Recipe
from model.config import Optimization, PVDAConfig
from model.schedule import Schedule
from pipeline.images.augmentation import Augmentation


def paper() -> Recipe:
    """PVDA at 256 px, as published."""
    return Recipe()


def paper_384() -> Recipe:
    """PVDA at 384 px, as published: nothing else changes [paper]."""
    return Recipe(name="paper_384", network=PVDAConfig(image_size=384))


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
