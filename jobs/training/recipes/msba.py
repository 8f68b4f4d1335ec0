"""MSBA (Zhuang, Remote Sensing 13(19) 3979), of which no code is public: a run in its style.

Known: ResNet-50, a global and a local branch, self-attention within blocks of the rings, cross-
entropy with a KL divergence. Not known: blocks and heads, where the attention sits, dropout, rates,
epochs, the weight of the divergence, the weights of the test's parts; chosen here: LPN's with a
global part, one attention head a ring, and the KL divergence between the views. Never to be
reported as a reproduction.
"""

from dataclasses import replace

from jobs.training.recipes.lpn import lpn_pvda_rates
from jobs.training.recipes.recipe import Recipe
from model.config import LossWeights, PVDAConfig


def msba_style() -> Recipe:
    """In the style of MSBA at 256 px: global part, four rings with attention, KL divergence."""
    return replace(
        lpn_pvda_rates(),
        name="msba_style",
        network=PVDAConfig(pooling="attended_rings", parts=5),
        losses=LossWeights(kl_weight=1.0),
        sampler="paired",
    )
