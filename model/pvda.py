"""The networks of PVDA: feature encoder, location classifier, view discriminator.

In: images as bytes (B, 3, H, W). Out: maps for the discriminator, one embedding per ring for the
classifier. Shapes: B images, H x W pixels or cells, C channels of the maps, P rings, D numbers per
ring, L locations.
"""

import torch
from torch import Tensor, nn

from model.backbones.base import build_backbone
from model.config import PVDAConfig
from model.parts.ring_pooling import ring_average


class FeatureEncoder(nn.Module):
    """Backbone, square rings and refinement; shared by both views."""

    mean_31: Tensor
    std_31: Tensor

    def __init__(self, config: PVDAConfig) -> None:
        """Raises ValueError where the backbone cannot have that width or take images of that size,
        or the images are too small for the rings."""
        super().__init__()
        self.parts, self.divisor = config.parts, config.ring_divisor
        self.backbone = build_backbone(config.backbone, config.width)
        least = max(2 * config.parts, 4) * self.backbone.stride  # D halves the maps twice
        if config.image_size < least:
            raise ValueError(
                f"image_size is {config.image_size}, expected at least {least} pixels for "
                f"{config.parts} parts; use larger images or fewer parts"
            )
        self.backbone.check_size(config.image_size, config.image_size)
        self.refine = nn.ModuleList(
            refinement(self.backbone.channels, config.part_dim) for _ in range(config.parts)
        )
        for name, values in (("mean_31", self.backbone.mean), ("std_31", self.backbone.std)):
            self.register_buffer(name, torch.tensor(values)[:, None, None], persistent=False)

    def forward(self, images_B3HW: Tensor) -> tuple[Tensor, Tensor]:
        """Bytes (B, 3, H, W) -> maps (B, C, H/stride, W/stride), one embedding g per ring (B, P,
        D).
        """
        normalised = (images_B3HW.to(self.mean_31.dtype) / 255 - self.mean_31) / self.std_31
        maps_BCHW = self.backbone(normalised)
        rings_BPC = ring_average(maps_BCHW, self.parts, self.divisor)
        g_BPD = torch.stack(
            [refine(rings_BPC[:, part]) for part, refine in enumerate(self.refine)], dim=1
        )
        return maps_BCHW, g_BPD


def refinement(channels: int, part_dim: int) -> nn.Sequential:
    """Linear and BatchNorm of one ring, initialised as LPN's."""
    linear, norm = nn.Linear(channels, part_dim), nn.BatchNorm1d(part_dim)
    nn.init.kaiming_normal_(linear.weight, mode="fan_out")
    nn.init.zeros_(linear.bias)
    nn.init.normal_(norm.weight, 1.0, 0.02)
    return nn.Sequential(linear, norm)


class LocationClassifier(nn.Module):
    """One linear classifier of locations per ring, shared by both views."""

    def __init__(self, config: PVDAConfig, locations: int) -> None:
        super().__init__()
        self.dropout = nn.Dropout(config.dropout)
        self.branches = nn.ModuleList(
            nn.Linear(config.part_dim, locations) for _ in range(config.parts)
        )
        for branch in self.branches:
            assert isinstance(branch, nn.Linear)
            nn.init.normal_(branch.weight, 0.0, 0.001)
            nn.init.zeros_(branch.bias)

    def forward(self, g_BPD: Tensor) -> Tensor:
        """Embeddings (B, P, D) -> logits (B, P, L)."""
        dropped_BPD = self.dropout(g_BPD)
        return torch.stack(
            [branch(dropped_BPD[:, part]) for part, branch in enumerate(self.branches)], dim=1
        )


class ViewDiscriminator(nn.Module):
    """D: maps -> is this a UAV's view (0) or a satellite's (1)? (PVDA, fig. 2)"""

    def __init__(self, config: PVDAConfig, channels: int) -> None:
        super().__init__()
        width = config.discriminator_channels
        self.blocks = nn.Sequential(
            nn.Conv2d(channels, width, 3, padding=1, bias=False),
            nn.BatchNorm2d(width),
            nn.Conv2d(width, width, 3, padding=1, bias=False),
            nn.BatchNorm2d(width),
            nn.AvgPool2d(2),
            nn.Conv2d(width, width, 3, padding=1, bias=False),
            nn.BatchNorm2d(width),
            nn.AvgPool2d(2),
            nn.ReLU(),
        )
        self.verdict = nn.Linear(width, 2)

    def forward(self, maps_BCHW: Tensor) -> Tensor:
        """Maps (B, C, H, W) -> logits (B, 2)."""
        verdict_B2: Tensor = self.verdict(self.blocks(maps_BCHW).mean((2, 3)))
        return verdict_B2
