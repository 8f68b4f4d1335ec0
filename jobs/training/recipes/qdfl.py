"""QDFL (Hu, TGRS 2025): learnt queries over the maps of a frozen DINOv2 with adapters.

From the public code and its log (Shuyu-Hu/QDFL), which tests at 280 px; here an encoder is tested
at its training's size. Its scheduler takes two steps an epoch by mistake, and its warm-up gives the
adapters the head's rate; here the rates follow one cosine.
"""

from jobs.training.recipes.recipe import Recipe
from model.config import LossWeights, Optimization, PVDAConfig
from model.schedule import Schedule
from pipeline.images.augmentation import Augmentation


def qdfl() -> Recipe:
    """QDFL at 224 px: two queries, class token and GeM; multi-similarity and JS; 160 epochs."""
    return Recipe(
        name="qdfl",
        network=PVDAConfig(
            backbone="dinov2_base_qdfl", image_size=224, pooling="queries", parts=4, dropout=0.5
        ),
        losses=LossWeights(location_mean=True, similarity_weight=2.0, js_weight=1.0),
        optimization=Optimization(backbone_lr=0.009, head_lr=0.03, classifier_lr=0.03),
        schedule=Schedule(
            epochs=160, lr_schedule="cosine", warmup_epochs=6.03, alpha=0.0, alpha_step=0.0,
            period=160,
        ),
        augmentation=Augmentation(chain="dac", mirror=False),
        adversary=False,
        sampler="paired",
        batch_size=24,
    )  # fmt: skip
