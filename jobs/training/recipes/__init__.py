"""Recipes: named configurations, one file per method, as functions that return a full one.

In: nothing. Out: a `Recipe`, whose every setting is a flag of `train.py NAME`. What is known of a
method and what was chosen stands in its file. Another method is one file here and its functions in
`RECIPES`. Begin with `recipe.py` and `pvda.py`.
"""

from collections.abc import Callable

from jobs.training.recipes.builtin import best, builtin, finetune
from jobs.training.recipes.camp import camp
from jobs.training.recipes.dac import dac
from jobs.training.recipes.fsra import fsra, fsra_3
from jobs.training.recipes.instance_loss import instance_loss
from jobs.training.recipes.lcm import lcm_style
from jobs.training.recipes.lpn import lpn, lpn_pvda_rates
from jobs.training.recipes.mccg import mccg
from jobs.training.recipes.msba import msba_style
from jobs.training.recipes.pcl import pcl_style
from jobs.training.recipes.pvda import (
    alpha_zero,
    constant_alpha,
    no_restart,
    paper,
    paper_384,
    smoke,
)
from jobs.training.recipes.pvda_unlabelled import pvda_unlabelled
from jobs.training.recipes.qdfl import qdfl
from jobs.training.recipes.recipe import Recipe
from jobs.training.recipes.sample4geo import sample4geo
from jobs.training.recipes.usam import usam, usam_lpn

RECIPES: dict[str, Callable[[], Recipe]] = {
    recipe.__name__: recipe
    for recipe in (
        paper,
        paper_384,
        constant_alpha,
        no_restart,
        alpha_zero,
        smoke,
        builtin,
        best,
        finetune,
        pvda_unlabelled,
        instance_loss,
        lcm_style,
        lpn,
        lpn_pvda_rates,
        usam,
        usam_lpn,
        pcl_style,
        msba_style,
        fsra,
        fsra_3,
        mccg,
        sample4geo,
        dac,
        camp,
        qdfl,
    )
}
