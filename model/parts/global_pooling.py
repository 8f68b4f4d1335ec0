"""One part for the whole image: the mean of its cells, or a generalised mean.

Shapes: B images, C channels, H x W cells.
"""

import torch
from torch import Tensor, nn

from model.config import PVDAConfig
from model.parts.base import PartPooling, require_parts


class Mean(PartPooling):
    """The mean of all cells [instance loss, Sample4Geo]."""

    def __init__(self, config: PVDAConfig, channels: int) -> None:
        super().__init__(config, channels)
        require_parts(config, 1)
        self.channels = (channels,)

    def forward(self, maps_BCHW: Tensor, token_BC: Tensor | None) -> list[Tensor]:
        """One part, (B, C)."""
        return [maps_BCHW.mean((2, 3))]


class GeM(PartPooling):
    """The generalised mean of all cells, (mean of x^p)^(1/p), with one p per channel that is learnt
    (Radenovic, TPAMI 2019; an option of the instance loss's public code).
    """

    START, LEAST = 3.0, 1e-6

    def __init__(self, config: PVDAConfig, channels: int) -> None:
        super().__init__(config, channels)
        require_parts(config, 1)
        self.channels = (channels,)
        self.power = nn.Parameter(torch.full((channels,), self.START))

    def forward(self, maps_BCHW: Tensor, token_BC: Tensor | None) -> list[Tensor]:
        """One part, (B, C)."""
        return [generalised_mean(maps_BCHW, self.power, self.LEAST)]


def generalised_mean(maps_BCHW: Tensor, power: Tensor, least: float) -> Tensor:
    """(mean over the cells of max(x, least)^p)^(1/p), (B, C), in float32; p a scalar or one per
    channel.
    """
    power_C11 = power.float().reshape(-1, 1, 1)
    raised_BC = maps_BCHW.float().clamp_min(least).pow(power_C11).mean((2, 3))
    return raised_BC.pow(1 / power.float()).to(maps_BCHW.dtype)
