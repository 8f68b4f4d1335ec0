"""ResNet and EfficientNet-Lite with USAM, attention to where the maps change: four numbers are
learnt [RK-Net].

In: normalised images (B, 3, H, W). Out: feature maps (B, C, H/16, W/16). Shapes: B images, C
channels, H x W cells.
"""

from typing import Self

import torch.nn.functional as F
from torch import Tensor, nn

from model.backbones.base import Backbone
from model.backbones.efficientnet_lite import EfficientNetLite
from model.backbones.resnet import ResNet

SUFFIX = "_usam"


class USAM(nn.Module):
    """Unit subtraction attention: maps weighted by how much the sum of a cell's channels exceeds
    that of its neighbours (Lin, TIP 2022). Two parameters, BatchNorm's.
    """

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.BatchNorm2d(1)

    def forward(self, maps_BCHW: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, C, H, W); cells at the edge are left as they are."""
        return maps_BCHW + maps_BCHW * self.attention(maps_BCHW).to(maps_BCHW.dtype)

    def attention(self, maps_BCHW: Tensor) -> Tensor:
        """(B, 1, H, W), in float32: bfloat16 would lose the difference of two large sums."""
        sums_B1HW = maps_BCHW.float().sum(1, keepdim=True)
        differences_B1HW = 9 * (sums_B1HW - F.avg_pool2d(sums_B1HW, 3, 1, 1))
        responses_B1HW = F.relu(self.norm(differences_B1HW))
        return F.pad(responses_B1HW[:, :, 1:-1, 1:-1], (1, 1, 1, 1))


class WithUSAM(Backbone):
    """What a family of backbones with two USAMs adds to the family; stands before it among the
    bases."""

    added = ("usam_",)

    def __init__(self, name: str, width: float) -> None:
        super().__init__(name.removesuffix(SUFFIX), width)
        self.usam_1, self.usam_2 = USAM(), USAM()

    @classmethod
    def infer(cls, state: dict[str, Tensor]) -> tuple[str, float]:
        """Name and width of a state dict that has the modules. Raises ValueError for another."""
        if not any(key.startswith("usam_") for key in state):
            raise ValueError("it has no usam_1")
        name, width = super().infer(state)
        return name + SUFFIX, width


class ResNetUSAM(WithUSAM, ResNet):
    """A ResNet with one USAM before the stem's pooling and one after layer1."""

    @classmethod
    def build(cls, name: str, width: float) -> Self:
        """As ResNet's."""
        cls.require_width(name.removesuffix(SUFFIX), width)
        return cls(name, width)

    def stages(self) -> list[list[nn.Module]]:
        """The stem, and layer1 to layer4."""
        stem, first, *others = super().stages()
        return [[*stem[:-1], self.usam_1, stem[-1]], [*first, self.usam_2], *others]


class EfficientNetLiteUSAM(WithUSAM, EfficientNetLite):
    """An EfficientNet-Lite with USAM where its maps have ResNet's sizes: after the stem, and after
    the last block at a quarter of the image's side [chosen]."""

    def stages(self) -> list[list[nn.Module]]:
        """The stem, the seven runs of blocks, the head."""
        stem, first, second, *others = super().stages()
        return [[*stem, self.usam_1], first, [*second, self.usam_2], *others]
