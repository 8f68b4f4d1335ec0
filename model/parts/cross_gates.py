"""Cross gates: the maps weighted along their height and their width by what the channels say
[MCCG].

Shapes: B images, C channels, H x W cells.
"""

import torch
from torch import Tensor, nn

from model.config import PVDAConfig
from model.parts.base import PartPooling, require_parts

KERNEL, MOMENTUM, NORM_EPS = 7, 0.01, 1e-6


class Gate(nn.Module):
    """Maps weighted by a gate over two of their dimensions, from the largest and the mean value
    over the third. 100 parameters.
    """

    def __init__(self, dims: tuple[int, int, int, int]) -> None:
        """`dims`: the order of the dimensions in which the third one comes first after the batch;
        it is its own inverse.
        """
        super().__init__()
        self.dims = dims
        self.conv = nn.Conv2d(2, 1, KERNEL, padding=KERNEL // 2, bias=False)
        self.norm = nn.BatchNorm2d(1, momentum=MOMENTUM)

    def forward(self, maps_BCHW: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, C, H, W)."""
        turned = maps_BCHW.permute(self.dims)
        summary = torch.stack([turned.amax(1), turned.mean(1)], dim=1)
        gated: Tensor = turned * self.norm(self.conv(summary)).sigmoid()
        return gated.permute(self.dims)


class CrossGates(PartPooling):
    """Three parts: the means of the maps gated over channels and width, and over channels and
    height, and the normalised mean of the maps. 200 parameters and those of the LayerNorm.
    """

    def __init__(self, config: PVDAConfig, channels: int) -> None:
        super().__init__(config, channels)
        require_parts(config, 3)
        self.channels = (channels,) * 3
        self.over_width, self.over_height = Gate((0, 2, 1, 3)), Gate((0, 3, 2, 1))
        self.norm = nn.LayerNorm(channels, eps=NORM_EPS)

    def forward(self, maps_BCHW: Tensor, token_BC: Tensor | None) -> list[Tensor]:
        """Three parts, (B, C) each: gated, gated, whole."""
        gated = [gate(maps_BCHW).mean((2, 3)) for gate in (self.over_width, self.over_height)]
        return [*gated, self.norm(maps_BCHW.mean((2, 3)))]
