"""Instance loss (Zheng, ACM MM 2020): one global part and a location classifier.

From the public code (train_no_street.py of layumi/University1652-Baseline), without street view:
the row "S + D" of its results, 58.23 / 62.91 and 74.47 / 59.45 (R@1 / AP, UAV -> satellite and
back).
"""

from jobs.training.recipes.lpn import step_decay
from jobs.training.recipes.recipe import Recipe
from model.config import PVDAConfig


def instance_loss() -> Recipe:
    """Instance loss at 256 px: global average, 120 epochs, rates to a tenth after 80."""
    return Recipe(
        name="instance_loss",
        network=PVDAConfig(pooling="mean", parts=1),
        schedule=step_decay(120, 80),
        adversary=False,
    )
