"""PVDA where no pair is known: an own gallery and flights over it, from trained weights on.

Known: PVDA's adversary needs the views alone, its location loss needs labels (arXiv 2401.01573);
UniABG (arXiv 2511.12054) bridges the views by an adversary and takes mutual neighbours for pairs.
Chosen: four rounds of three epochs, InfoNCE on the pairs, no location loss (classes of wrong pairs
would be learnt by heart), an alpha from 0.1 that grows by 0.1 a round, the rates of `finetune`.
What D sees are the images of the step's pairs. Not a reproduction of UniABG.
"""

from dataclasses import replace

from jobs.training.recipes.builtin import finetune
from jobs.training.recipes.recipe import Recipe
from model.config import LossWeights
from model.schedule import Schedule


def pvda_unlabelled(rounds: int = 4, round_epochs: int = 3) -> Recipe:
    """The built-in encoder on views without labels: new pseudo-pairs each round, the adversary.

    `--no-adversary` is its control; other weights to start from are given by `--weights`.
    """
    return replace(
        finetune(),
        name="pvda_unlabelled",
        losses=LossWeights(location_weight=0.0, contrastive_weight=1.0),
        schedule=Schedule(
            epochs=rounds * round_epochs, alpha=0.1, alpha_step=0.1, period=round_epochs,
            decay_epochs=(round_epochs - 1,),
        ),
        adversary=True,
        pseudo_neighbours=4,
    )  # fmt: skip
