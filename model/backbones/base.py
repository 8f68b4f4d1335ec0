"""What the encoder asks of a backbone, and how one is built by its name.

In: a name of `BACKBONES` and a width. Out: the module with its stride, channels, normalisation and
table of foreign names.
"""

from importlib import import_module
from typing import ClassVar, Protocol, cast

from torch import Tensor, nn

from model.backbones import BACKBONES

MAX_CHANNELS = 65_536
"Beyond any use; a checkpoint from elsewhere may name any width."


class Backbone(nn.Module):
    """Normalised images (B, 3, H, W) -> maps (B, C, H/stride, W/stride)."""

    stride: ClassVar[int]
    "Pixels of the image per cell of the maps."
    mean: ClassVar[tuple[float, float, float]]
    "Of red, green and blue in 0..1; subtracted from images before they come in."
    std: ClassVar[tuple[float, float, float]]
    "Likewise; images are divided by it."
    foreign_names: ClassVar[dict[str, str]]
    "Patterns of this module's tensor names -> the names in public weights; empty where they agree."
    foreign_extra: ClassVar[tuple[str, ...]]
    "Beginnings of names in public weights that this module has no use for, such as a classifier's."
    channels: int
    "C, the channels of the maps."


class Family(Protocol):
    """What a module of `BACKBONES` offers."""

    def build(self, name: str, width: float) -> Backbone:
        """The backbone of that name, `width` times as wide as published.

        Raises ValueError for a width that it cannot have.
        """

    def infer(self, state: dict[str, Tensor]) -> tuple[str, float]:
        """Name and width of the backbone that a public state dict belongs to.

        Raises ValueError that says how the state dict differs from all of the family.
        """


def families() -> list[Family]:
    """Each module of `BACKBONES` once."""
    return [cast(Family, import_module(module)) for module in dict.fromkeys(BACKBONES.values())]


def build_backbone(name: str, width: float) -> Backbone:
    """The backbone of a name in `BACKBONES`. Raises ValueError as `Family.build` does."""
    return cast(Family, import_module(BACKBONES[name])).build(name, width)
