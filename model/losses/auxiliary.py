"""What some losses learn beside the networks: weights of the maps' cells, and heads that only
training has.

Shapes: B images, C channels, H x W cells, N = H * W, K channels of the cells' weights, P parts.
"""

import math
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.config import PVDAConfig
from model.losses.contrastive import info_nce
from model.losses.pvda import location_by_part
from model.parts.base import build_pooling
from model.parts.heat_regions import heat_regions
from model.parts.necks import build_neck
from model.pvda import LocationClassifier


class AlignmentMaps(nn.Module):
    """Maps stacked with the weights of their cells, which two convolutions learn [DAC].

    Parameters at C = 1024: 2,625,536.
    """

    WIDTH, WEIGHTS = 2048, 256

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.project = nn.Sequential(
            nn.Conv2d(channels, self.WIDTH, 1, bias=False),
            nn.BatchNorm2d(self.WIDTH),
            nn.ReLU(),
            nn.Conv2d(self.WIDTH, self.WEIGHTS, 1, bias=False),
        )
        for layer in self.project:
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, maps_BCHW: Tensor) -> Tensor:
        """Maps (B, C, H, W) -> (B, C + K, N); a channel's weights sum to one over the cells."""
        maps_BCHW = maps_BCHW.float()  # they may come from networks in bfloat16
        logits_BKN = F.normalize(self.project(maps_BCHW), dim=1).flatten(2)
        return torch.cat([maps_BCHW.flatten(2), logits_BKN.softmax(2)], dim=1)


class GateHeads(nn.Module):
    """MCCG's three parts with necks and classifiers of their own, in training only [DAC]."""

    def __init__(self, config: PVDAConfig, channels: int, locations: int) -> None:
        super().__init__()
        heads = replace(
            config, pooling="cross_gates", parts=3, neck="linear_ones", part_dim=512, dropout=0.5
        )
        self.pooling = build_pooling(heads, channels)
        self.necks = nn.ModuleList(
            build_neck(heads.neck, width, heads.part_dim) for width in self.pooling.channels
        )
        self.classifier = LocationClassifier(heads, locations)

    def forward(self, maps_BCHW: Tensor, location_B: Tensor) -> Tensor:
        """The location loss of one view's maps, the mean over the parts."""
        parts = self.pooling(maps_BCHW.float(), None)
        g_BPD = torch.stack([neck(part) for neck, part in zip(self.necks, parts, strict=True)], 1)
        return location_by_part(self.classifier(g_BPD), location_B).mean()


class RegionContrast(nn.Module):
    """InfoNCE of each view's heat regions against themselves, so that places move apart [CAMP].

    Learnt: an embedding of the cells' positions and its weight (from 0.6), the logits' scale (from
    1 / 0.07), and the balance of the views (from 0.5).
    """

    REGIONS, LABEL_SMOOTHING = 3, 0.1

    def __init__(self, channels: int, cells: int) -> None:
        """Maps of `channels`, of `cells` a side."""
        super().__init__()
        self.positions = nn.Parameter(torch.empty(1, channels, cells, cells))
        nn.init.trunc_normal_(self.positions, std=0.02)
        self.position_weight = nn.Parameter(torch.tensor(0.6))
        self.log_scale = nn.Parameter(torch.tensor(math.log(1 / 0.07)))
        self.balance = nn.Parameter(torch.tensor(0.5))

    def forward(self, drone_BCHW: Tensor, satellite_BCHW: Tensor, location_B: Tensor) -> Tensor:
        """0.5 w B(satellite) + 0.5 / w B(UAV), w the balance."""
        satellite, drone = (
            self._spread(maps_BCHW, location_B) for maps_BCHW in (satellite_BCHW, drone_BCHW)
        )
        return 0.5 * self.balance * satellite + 0.5 / self.balance * drone

    def _spread(self, maps_BCHW: Tensor, location_B: Tensor) -> Tensor:
        placed_BCHW = maps_BCHW.float() + self.position_weight * self.positions
        regions_BRC = heat_regions(placed_BCHW.flatten(2).transpose(1, 2), self.REGIONS)
        unit_BE = F.normalize(regions_BRC.flatten(1), dim=1)
        temperature = (-self.log_scale).exp()
        return info_nce(unit_BE, unit_BE, location_B, temperature, self.LABEL_SMOOTHING)
