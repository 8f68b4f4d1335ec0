"""MCCG (Shen, TCSVT 2023): ConvNeXt-T, its maps gated along height and width.

From the public code (mode-str/crossview: train.py, models/ConvNext), whose augmentation flags are
inverted: AutoAugment and random erasing are on. The code keeps the checkpoint of least training
loss; the last is to be used.
"""

from jobs.training.recipes.lpn import step_decay
from jobs.training.recipes.recipe import Recipe
from model.config import LossWeights, Optimization, PVDAConfig
from pipeline.images.augmentation import Augmentation


def mccg() -> Recipe:
    """MCCG at 256 px: two gated parts and the global one, triplet loss, 200 epochs."""
    return Recipe(
        name="mccg",
        network=PVDAConfig(
            backbone="convnext_tiny", pooling="cross_gates", parts=3, neck="linear_ones",
            dropout=0.5,
        ),
        losses=LossWeights(location_mean=True, triplet_weight=1.0),
        optimization=Optimization(backbone_lr=0.003, head_lr=0.01, classifier_lr=0.01),
        schedule=step_decay(200, 80, 120),
        augmentation=Augmentation(chain="mccg"),
        adversary=False,
        sampler="paired",
    )  # fmt: skip
