"""CAMP (Wu, TGRS 2024): DAC's training with another term, the contrast of regions within a view.

From the public code (Mabel0403/CAMP). Its heads of a location loss have weight 0 there and are left
out.
"""

from dataclasses import replace

from jobs.training.recipes.dac import dac
from jobs.training.recipes.recipe import Recipe


def camp() -> Recipe:
    """CAMP at 384 px: InfoNCE, and each view's heat regions against those of other places."""
    base = dac()
    weights = replace(base.losses, gates_weight=0.0, alignment_weight=0.0, regions_weight=1.0)
    return replace(base, name="camp", losses=weights)
