"""LCM (Ding, Remote Sensing 13(1) 47), of which no code is public: a run in its style.

Known: ResNet-50 at 384 px, places as classes, satellite images multiplied by augmentation against
their scarcity. Not known: which augmentation, how many copies, rates, epochs, dropout; chosen here:
the instance-loss baseline with random erasing, and three times its epochs, so that more looks of
each satellite image are seen. Never to be reported as a reproduction.
"""

from dataclasses import replace

from jobs.training.recipes.instance_loss import instance_loss
from jobs.training.recipes.lpn import step_decay
from jobs.training.recipes.recipe import Recipe
from pipeline.images.augmentation import Augmentation


def lcm_style() -> Recipe:
    """In the style of LCM at 384 px: instance loss, random erasing, 360 epochs."""
    base = instance_loss()
    return replace(
        base,
        name="lcm_style",
        network=replace(base.network, image_size=384),
        schedule=step_decay(360, 240),
        augmentation=Augmentation(erase=0.5),
    )
