"""A method at a budget of images that two cores can bear, on one backbone, beside all others.

In: a method's recipe. Out: a recipe with the method's parts, neck, losses, sampler, adversary, USAM
and the shape of its schedule; backbone, start, optimizer, rates, batch and augmentation are the
same for every method. What is compared is then the ingredients and not what each was tuned with.
"""

from dataclasses import replace

from jobs.training.recipes.builtin import builtin
from jobs.training.recipes.recipe import Recipe
from model.backbones import usam
from model.backbones.base import build_backbone
from model.shapes_alone import shapes_alone

PART_DIM, DISCRIMINATOR_CHANNELS = 256, 256
"A quarter to a half of the published widths, as the backbone's is [chosen]."


def at_equal_budget(recipe: Recipe, epochs: int, seed: int) -> Recipe:
    """The method's recipe on the built-in encoder's terms, its schedule shrunk to `epochs`."""
    terms = builtin()
    attention = usam.SUFFIX if recipe.network.backbone.endswith(usam.SUFFIX) else ""
    network = replace(
        recipe.network,
        backbone=terms.network.backbone + attention,
        width=terms.network.width,
        image_size=terms.network.image_size,
        part_dim=PART_DIM,
        discriminator_channels=DISCRIMINATOR_CHANNELS,
    )
    if network.neck == "norm":  # it keeps the backbone's channels
        with shapes_alone():
            channels = build_backbone(network.backbone, network.width).channels
        network = replace(network, part_dim=channels)
    return replace(
        recipe,
        network=network,
        schedule=recipe.schedule.scaled_to(epochs),
        start=terms.start,
        optimization=terms.optimization,
        augmentation=terms.augmentation,
        batch_size=terms.batch_size,
        joint_bn=terms.joint_bn,
        pair_repeats=1,
        seed=seed,
    )
