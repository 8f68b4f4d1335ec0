"""The networks of PVDA: feature encoder, location classifier, view discriminator.

In: images as bytes (B, 3, H, W). Out: maps for the discriminator, one embedding per part for the
classifier. Shapes: B images, H x W pixels or cells, C channels of the maps, P parts, D numbers per
part, L locations.
"""

import torch
from torch import Tensor, nn

from model.backbones.base import build_backbone
from model.config import PVDAConfig
from model.parts.base import build_pooling
from model.parts.necks import build_neck


class FeatureEncoder(nn.Module):
    """Backbone, part pooling and necks; shared by both views."""

    mean_31: Tensor
    std_31: Tensor

    def __init__(self, config: PVDAConfig) -> None:
        """Raises ValueError where the backbone cannot have that width or take images of that size,
        the images are too small for the parts, or these cannot be made of this backbone's maps."""
        super().__init__()
        self.backbone = build_backbone(config.backbone, config.width)
        self.pooling = build_pooling(config, self.backbone.channels)
        self.with_token = self.backbone.has_token
        least = max(self.pooling.least_cells, 4) * self.backbone.stride  # D halves the maps twice
        if config.image_size < least:
            raise ValueError(
                f"image_size is {config.image_size}, expected at least {least} pixels for "
                f"{config.parts} parts; use larger images or fewer parts"
            )
        self.backbone.check_size(config.image_size, config.image_size)
        self.refine = nn.ModuleList(
            build_neck(config.neck, channels, config.part_dim) for channels in self.pooling.channels
        )
        for name, values in (("mean_31", self.backbone.mean), ("std_31", self.backbone.std)):
            self.register_buffer(name, torch.tensor(values)[:, None, None], persistent=False)

    def forward(self, images_B3HW: Tensor) -> tuple[Tensor, Tensor]:
        """Bytes (B, 3, H, W) -> maps (B, C, H/stride, W/stride), one embedding g per part (B, P,
        D).
        """
        normalised = (images_B3HW.to(self.mean_31.dtype) / 255 - self.mean_31) / self.std_31
        # A backbone in 8-bit integers is a graph that has no more than `forward`.
        maps_BCHW, token_BC = (
            self.backbone.features(normalised)
            if self.with_token
            else (self.backbone(normalised), None)
        )
        parts = self.pooling(maps_BCHW, token_BC)
        g_BPD = torch.stack(
            [refine(part_BC) for refine, part_BC in zip(self.refine, parts, strict=True)], dim=1
        )
        return maps_BCHW, g_BPD


class LocationClassifier(nn.Module):
    """One linear classifier of locations per part, shared by both views."""

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
        """Embeddings (B, P, D) -> logits (B, P, L), in training of embeddings with dropout."""
        return self.classify(self.dropout(g_BPD))

    def classify(self, dropped_BPD: Tensor) -> Tensor:
        """Embeddings after dropout (B, P, D) -> logits (B, P, L)."""
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
