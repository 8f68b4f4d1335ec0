"""DAC (Xia, TCSVT 2024): Sample4Geo with MCCG's heads in training and densely aligned maps.

From the public code (SummerpanKing/DAC): 24 pairs a step, 1,577 steps, which are 54 passes over the
satellite view; the rates grow over the first tenth. Tested by the one part of 1,024 numbers.
"""

from dataclasses import replace

from jobs.training.recipes.recipe import Recipe
from jobs.training.recipes.sample4geo import sample4geo


def dac() -> Recipe:
    """DAC at 384 px: InfoNCE, a tenth of MCCG's location loss, dense alignment of the maps."""
    base = sample4geo()
    return replace(
        base,
        name="dac",
        losses=replace(base.losses, gates_weight=0.1, alignment_weight=0.6),
        schedule=replace(base.schedule, epochs=54, period=54, warmup_epochs=5.4),
        augmentation=replace(base.augmentation, chain="dac"),
        batch_size=24,
    )
