"""Sample4Geo (Deuser, ICCV 2023, arXiv 2303.11851): InfoNCE on pairs of distinct places, no more.

From the public code (Skyy93/Sample4Geo: train_university.py). One of its epochs is a pass over all
UAV images, 295 steps of 128 pairs: 59 passes over the satellite view here. Its published figures
are on the gallery without distractors (docs/method.md, protocols).
"""

from jobs.training.recipes.recipe import Recipe
from model.config import LossWeights, Optimization, PVDAConfig
from model.schedule import Schedule
from pipeline.images.augmentation import Augmentation


def sample4geo() -> Recipe:
    """Sample4Geo at 384 px: ConvNeXt-B, one part of 1,024 numbers, 128 pairs a step, one cosine."""
    return Recipe(
        name="sample4geo",
        network=PVDAConfig(
            backbone="convnext_base", image_size=384, pooling="mean", parts=1, neck="norm",
            part_dim=1024, dropout=0.0,
        ),
        losses=LossWeights(
            location_weight=0.0, contrastive_weight=1.0, temperature=0.07, learn_temperature=True
        ),
        optimization=Optimization(
            optimizer="adamw", backbone_lr=1e-3, head_lr=1e-3, classifier_lr=1e-3,
            weight_decay=0.01, clip_value=100.0,
        ),
        schedule=Schedule(
            epochs=59, lr_schedule="cosine", warmup_epochs=6.0, alpha=0.0, alpha_step=0.0, period=59
        ),
        augmentation=Augmentation(chain="sample4geo", pair_mirror=True, mirror=False),
        adversary=False,
        sampler="unique_pairs",
        batch_size=128,
    )  # fmt: skip
