"""Named configurations as functions that return the whole of it."""

from dataclasses import dataclass, field

from model.pvda import PVDAConfig
from model.schedule import Schedule
from model.training import Optimisation, Precision
from pipeline.records import InputError
from pipeline.transforms import Augmentation


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """All that decides what training computes, besides the data and the number of workers."""

    name: str = "paper"
    "Under which it is known."
    network: PVDAConfig = field(default_factory=PVDAConfig)
    optimisation: Optimisation = field(default_factory=Optimisation)
    schedule: Schedule = field(default_factory=Schedule)
    augmentation: Augmentation = field(default_factory=Augmentation)
    adversary: bool = True
    "Whether there is a view discriminator; without it PVDA is LPN."
    batch_size: int = 8
    "Images of each view per step and worker [LPN lineage: 8]."
    seed: int = 0
    "Of the weights, the data's order and the augmentation."
    precision: Precision = "auto"
    "Of the networks' products: float32, bfloat16 by autocast, or auto: bfloat16 on CUDA, float32 on a CPU [chosen]."
    sync_bn: bool = False
    "Whether BatchNorm's statistics are those of all workers' images; GPUs only [chosen: each worker's own]."
    hold_out: float = 0.0
    "Share of the training locations that is not trained on but looked at every `probe_epochs` [chosen: none]."

    def __post_init__(self) -> None:
        if self.batch_size < 2:
            raise InputError(
                f"batch_size is {self.batch_size}, expected at least 2: BatchNorm needs two images of a view"
            )
        if not 0 <= self.hold_out < 1:
            raise InputError(f"hold_out is {self.hold_out}, expected a share of the locations, from 0 to below 1")


def paper() -> Recipe:
    """PVDA at 256 px, as published."""
    return Recipe()


def smoke(epochs: int = 80) -> Recipe:
    """Minutes on two cores, from scratch: a thin ResNet-18 with AdamW, one cosine and a gentle adversary.

    The paper's rates suppose ImageNet weights and days of training; from scratch they learn nothing in minutes. It stays
    the two-step method on the same code.
    """
    return Recipe(
        name="smoke",
        network=PVDAConfig(
            depth=18, width=0.25, image_size=64, parts=2, part_dim=128, dropout=0.0, discriminator_channels=64
        ),
        optimisation=Optimisation(
            kind="adamw", backbone_rate=3e-3, head_rate=3e-3, classifier_rate=3e-3, discriminator_rate=1e-3
        ),
        schedule=Schedule(epochs=epochs, shape="cosine", warmup_epochs=4, alpha=0.1, alpha_step=0.0),
        augmentation=Augmentation(pad=4, rotation=180),
        batch_size=16,
    )


RECIPES = {recipe.__name__: recipe for recipe in (paper, smoke)}
