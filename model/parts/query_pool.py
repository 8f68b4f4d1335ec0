"""Learnt queries over the cells of the maps, the class token, and a generalised mean [QDFL].

From the public code (Shuyu-Hu/QDFL); steps are numbered as they are taken. Shapes: B images, C
channels, H x W cells, N = H * W, D numbers of a part, Q queries.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.config import PVDAConfig
from model.parts.base import PartPooling, require_parts
from model.parts.global_pooling import generalised_mean

DIM, HEADS, QUERIES, MIXED = 512, 8, 8, 2
"Numbers of a cell and of a part, heads of attention, queries learnt, queries that come out."
POWER, LEAST = 4.5, 1e-7
"Of the generalised mean: where its exponent starts, and the least value."
GATE_DIM = 170
"Numbers within the gate of the three maps: D / 3."
QUERY_STD = 1e-6


class ShiftedConv(nn.Module):
    """A 1x1 convolution whose channel i sees the cell that is ((i + 1) mod 3) - 1 away along one
    axis, zero beyond the edge (CycleFC).
    """

    def __init__(self, axis: int) -> None:
        """`axis`: 2 shifts along the height, 3 along the width."""
        super().__init__()
        self.axis, self.conv = axis, nn.Conv2d(DIM, DIM, 1)

    def forward(self, maps_BDHW: Tensor) -> Tensor:
        """(B, D, H, W) -> (B, D, H, W)."""
        out: Tensor = self.conv(shift_channels(maps_BDHW, self.axis))
        return out


def shift_channels(maps_BDHW: Tensor, axis: int) -> Tensor:
    """Channel i read at the offset ((i + 1) mod 3) - 1 along `axis`, zeros outside."""
    size = maps_BDHW.shape[axis]
    padding = (0, 0, 1, 1) if axis == 2 else (1, 1)
    padded = F.pad(maps_BDHW, padding)
    shifted = torch.empty_like(maps_BDHW)
    for first in range(3):
        start = (first + 1) % 3  # the offset, and one cell of padding
        shifted[:, first::3] = padded[:, first::3].narrow(axis, start, size)
    return shifted


class FeatureFusion(nn.Module):
    """The maps and two shifted convolutions of them, weighted by channel and added."""

    def __init__(self) -> None:
        super().__init__()
        self.along_width, self.along_height = ShiftedConv(3), ShiftedConv(2)
        self.gate = nn.Sequential(nn.Linear(DIM, GATE_DIM), nn.ReLU(), nn.Linear(GATE_DIM, 3 * DIM))

    def forward(self, maps_BDHW: Tensor) -> Tensor:
        """Square maps (B, D, H, H) -> the same. The second convolution sees the maps transposed and
        they are not turned back, as in the public code.
        """
        width, height = self.along_width(maps_BDHW), self.along_height(maps_BDHW.transpose(2, 3))
        mean_BD = (width + height + maps_BDHW).mean((2, 3))
        shares_BD3 = self.gate(mean_BD).unflatten(1, (DIM, 3)).softmax(2)
        stacked = torch.stack([width, height, maps_BDHW], dim=2)
        fused: Tensor = torch.einsum("bdkhw,bdk->bdhw", stacked, shares_BD3) + maps_BDHW
        return fused


class QueryPool(PartPooling):
    """Four parts: two mixed queries, the class token (the maps' mean where there is none [chosen]),
    and the generalised mean of the fused maps.
    """

    def __init__(self, config: PVDAConfig, channels: int) -> None:
        super().__init__(config, channels)
        require_parts(config, MIXED + 2)
        self.channels = (*(DIM,) * MIXED, channels, DIM)
        self.reduce = nn.Conv2d(channels, DIM, 1)
        self.queries = nn.Parameter(QUERY_STD * torch.randn(1, QUERIES, DIM))
        self.over_cells, self.over_queries, self.cross, self.last = (
            nn.MultiheadAttention(DIM, HEADS, batch_first=True) for _ in range(4)
        )
        self.cells_norm, self.queries_norm, self.cross_norm, self.between_norm, self.last_norm = (
            nn.LayerNorm(DIM) for _ in range(5)
        )
        self.fusion = FeatureFusion()
        self.mix = nn.Linear(QUERIES, MIXED)
        self.power = nn.Parameter(torch.tensor(POWER))
        for module in (*self.fusion.modules(), self.mix):
            if isinstance(module, nn.Linear):
                nn.init.trunc_normal_(module.weight, std=0.02)
                nn.init.zeros_(module.bias)

    def forward(self, maps_BCHW: Tensor, token_BC: Tensor | None) -> list[Tensor]:
        """Four parts: (B, D), (B, D), (B, C), (B, D)."""
        reduced_BDHW = self.reduce(maps_BCHW)  # 1
        cells_BND = reduced_BDHW.flatten(2).transpose(1, 2)
        attended_BND = self.cells_norm(cells_BND + _attend(self.over_cells, cells_BND))  # 2
        queries_BQD = self.queries.expand(len(maps_BCHW), -1, -1)
        own_BQD = self.queries_norm(queries_BQD + _attend(self.over_queries, queries_BQD))  # 3
        crossed_BQD = self.cross_norm(_attend(self.cross, own_BQD, attended_BND))
        mixed_BDHW = (attended_BND + cells_BND).transpose(1, 2).unflatten(2, maps_BCHW.shape[2:])
        fused_BDHW = self.fusion(mixed_BDHW)  # 4, 5
        between_BQD = self.between_norm(crossed_BQD)
        fused_BND = fused_BDHW.flatten(2).transpose(1, 2)
        found_BQD = self.last_norm(between_BQD + _attend(self.last, between_BQD, fused_BND))  # 6
        first_BD, second_BD = self.mix(found_BQD.transpose(1, 2)).unbind(2)
        mean_BD = F.normalize(generalised_mean(fused_BDHW, self.power, LEAST), dim=1)  # 7
        whole_BC = maps_BCHW.mean((2, 3)) if token_BC is None else token_BC
        return [first_BD, second_BD, whole_BC, mean_BD]


def _attend(attention: nn.Module, asked: Tensor, given: Tensor | None = None) -> Tensor:
    given = asked if given is None else given
    out: Tensor = attention(asked, given, given, need_weights=False)[0]
    return out
