"""USAM (RK-Net, Lin, TIP 2022): attention of four numbers within the ResNet; alone, and with LPN.

From the public code (AggMan96/RK-Net). Its loop runs for 999 epochs and saves every 20; which of
them was reported is not known: 400 are chosen. USAM + LPN is not in that code: the two modules in
LPN's backbone [inferred].
"""

from dataclasses import replace

from jobs.training.recipes.lpn import lpn_pvda_rates, step_decay
from jobs.training.recipes.recipe import Recipe
from model.config import PVDAConfig


def usam() -> Recipe:
    """USAM at 384 px: global average, dropout 0.65, rates to a tenth after 200 of 400 epochs."""
    return Recipe(
        name="usam",
        network=PVDAConfig(
            backbone="resnet50_usam", image_size=384, pooling="mean", parts=1, dropout=0.65
        ),
        schedule=step_decay(400, 200),
        adversary=False,
    )


def usam_lpn() -> Recipe:
    """USAM in LPN's backbone at 256 px, LPN's schedule."""
    base = lpn_pvda_rates()
    return replace(base, name="usam_lpn", network=PVDAConfig(backbone="resnet50_usam"))
