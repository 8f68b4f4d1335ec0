"""The networks of PVDA: feature encoder, location classifier, view discriminator.

In: images as bytes (B, 3, H, W). Out: maps for the discriminator, one embedding per ring for the
classifier. Shapes: B images, H x W pixels or cells, C channels of the maps, P rings, D numbers per
ring, L locations.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from model.backbones.resnet import BLOCKS, LEAST_CHANNELS, STRIDE, Depth, ResNet, layer1_channels
from model.parts.ring_pooling import Divisor, ring_average

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"Of red, green and blue in 0..1: what torchvision's weights were trained with."
LARGEST_IMAGE, MOST_CHANNELS = 16_384, 65_536
"Beyond any use; a checkpoint from elsewhere may say anything."


@dataclass(frozen=True, kw_only=True)
class PVDAConfig:
    """Sizes of the networks. The defaults are the paper's at 256 px."""

    depth: Depth = 50
    "Layers of the ResNet: 18, 34, 50 or 101 [paper: 50]."
    width: float = 1.0
    "Channels of the ResNet as a multiple of the published ones [paper: 1]."
    image_size: int = 256
    "Side of the square images in pixels [paper: 256, 384]."
    parts: int = 4
    "Square rings P [paper: 4]."
    ring_divisor: Divisor = "box"
    "What a ring's sum is divided by: the area of its `box` [LPN] or of the `ring`."
    part_dim: int = 512
    "Numbers D per ring after refinement [paper: 512]."
    dropout: float = 0.75
    "Before the location classifier [paper, LPN]."
    discriminator_channels: int = 1024
    "Of the view discriminator's convolutions [paper, fig. 2]."

    def __post_init__(self) -> None:
        if self.depth not in BLOCKS:
            raise ValueError(
                f"depth is {self.depth}, expected one of {', '.join(map(str, BLOCKS))}"
            )
        if layer1_channels(self.depth, self.width) < LEAST_CHANNELS:
            raise ValueError(
                f"width is {self.width}, which gives layer1 of a ResNet-{self.depth} "
                f"{layer1_channels(self.depth, self.width)} channels; expected at least {LEAST_CHANNELS} (thinner ones crash "
                "oneDNN); use a larger width"
            )
        for name, most in (
            ("image_size", LARGEST_IMAGE),
            ("part_dim", MOST_CHANNELS),
            ("discriminator_channels", MOST_CHANNELS),
        ):
            if not 1 <= getattr(self, name) <= most:
                raise ValueError(f"{name} is {getattr(self, name)}, expected 1 to {most}")
        if layer1_channels(self.depth, self.width) > MOST_CHANNELS or self.parts < 1:
            raise ValueError(
                f"width is {self.width} and parts {self.parts}, expected a network that some machine can hold"
            )
        least = max(2 * self.parts, 4) * STRIDE  # the discriminator halves the maps twice
        if self.image_size < least:
            raise ValueError(
                f"image_size is {self.image_size}, expected at least {least} pixels for {self.parts} parts; "
                "use larger images or fewer parts"
            )

    @property
    def embedding_dim(self) -> int:
        """Length of an image's embedding: P * D."""
        return self.parts * self.part_dim


class FeatureEncoder(nn.Module):
    """Backbone, square rings and refinement; shared by both views."""

    mean_31: Tensor
    std_31: Tensor

    def __init__(self, config: PVDAConfig) -> None:
        super().__init__()
        self.parts, self.divisor = config.parts, config.ring_divisor
        self.backbone = ResNet(config.depth, config.width)
        self.refine = nn.ModuleList(
            refinement(self.backbone.channels, config.part_dim) for _ in range(config.parts)
        )
        for name, values in (("mean_31", IMAGENET_MEAN), ("std_31", IMAGENET_STD)):
            self.register_buffer(name, torch.tensor(values)[:, None, None], persistent=False)

    def forward(self, images_B3HW: Tensor) -> tuple[Tensor, Tensor]:
        """Bytes (B, 3, H, W) -> maps (B, C, H/16, W/16) and one embedding g per ring (B, P, D)."""
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
