"""LPN (Wang, TCSVT 2022): square rings and a location classifier each; and with PVDA's rates.

From the public code (run.sh, train.py, model.py of wtyhub/LPN). The views are PVDA's two; LPN's own
runs on University-1652 add street-view images through a second backbone.
"""

from dataclasses import replace

from jobs.training.recipes.recipe import Recipe
from model.config import Optimization
from model.schedule import Schedule


def step_decay(epochs: int, *decay_epochs: int) -> Schedule:
    """Rates to a tenth at these epochs, and no adversary's weight: the lineage's schedule."""
    return Schedule(
        epochs=epochs, alpha=0.0, alpha_step=0.0, period=epochs, decay=0.1,
        decay_epochs=decay_epochs, restart=False,
    )  # fmt: skip


def lpn() -> Recipe:
    """LPN at 256 px: four rings, 120 epochs at its own rates, to a tenth after 80."""
    return Recipe(
        name="lpn",
        optimization=Optimization(backbone_lr=1e-4, head_lr=1e-3, classifier_lr=1e-3),
        schedule=step_decay(120, 80),
        adversary=False,
    )


def lpn_pvda_rates() -> Recipe:
    """LPN at ten times its rates, which are those of PVDA and of the instance-loss baseline."""
    return replace(lpn(), name="lpn_pvda_rates", optimization=Optimization())
