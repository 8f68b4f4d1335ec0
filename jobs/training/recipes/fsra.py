"""FSRA (Dai, TCSVT 2022, arXiv 2201.09206): a transformer's tokens grouped by their heat.

From the public code (Dmmm1997/FSRA: train.py, models/FSRA). The KL divergence is an option there
that its script leaves off.
"""

from dataclasses import replace

from jobs.training.recipes.lpn import step_decay
from jobs.training.recipes.recipe import Recipe
from model.config import LossWeights, Optimization, PVDAConfig
from pipeline.images.augmentation import Augmentation


def fsra() -> Recipe:
    """FSRA at 256 px: three heat regions and the class token, triplet loss, 120 epochs."""
    return Recipe(
        name="fsra",
        network=PVDAConfig(
            backbone="vit_small_fsra", pooling="heat_regions", parts=4, neck="linear_ones",
            dropout=0.5,
        ),
        losses=LossWeights(location_mean=True, triplet_weight=1.0),
        optimization=Optimization(backbone_lr=0.003, head_lr=0.01, classifier_lr=0.01),
        schedule=step_decay(120, 70, 110),
        augmentation=Augmentation(pad=0),
        adversary=False,
        sampler="paired",
    )  # fmt: skip


def fsra_3() -> Recipe:
    """FSRA with each location three times an epoch (its k = 3)."""
    return replace(fsra(), name="fsra_3", pair_repeats=3)
