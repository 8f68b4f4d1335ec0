"""A conditional GAN that makes UAV images, laid on the ground, look like satellite images.

The second stage of PCL (Tian, TCSVT 2021), of which the abstract says only that it is a conditional
GAN. Generator, discriminator, losses and rates are pix2pix's (Isola, CVPR 2017) [chosen]: a U-Net,
patches of 70 x 70 pixels judged beside their condition, cross-entropy and 100 times L1. In: bytes
(B, 3, S, S) of both views of the same places. Out: bytes. Shapes: B images, S x S pixels.
"""

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

LEAKY = 0.2
DROPPED_BLOCKS, DROPOUT = 3, 0.5
"Of the decoder, from the innermost; as pix2pix."
DEEPEST = 8
"Halvings of the largest U-Net: 256 pixels to one."


@dataclass(frozen=True, kw_only=True)
class TranslationConfig:
    """The networks and their training. The defaults are pix2pix's."""

    side: int = 256
    "Of the images in pixels: a power of 2, at least 32."
    channels: int = 64
    "Of the outermost layers; inner ones have up to 8 times as many."
    l1_weight: float = 100.0
    "Of the distance to the real satellite image, beside the adversarial loss."
    rate: float = 2e-4
    "Of Adam, falling to 0 over the second half of the epochs."

    def __post_init__(self) -> None:
        if self.side < 32 or self.side & (self.side - 1):
            raise ValueError(f"side is {self.side}, expected a power of 2, 32 or more")
        if self.channels < 1:
            raise ValueError(f"channels is {self.channels}, expected 1 or more")


def _down(given: int, made: int, stride: int, norm: bool, bias: bool = False) -> nn.Sequential:
    layers: list[nn.Module] = [nn.Conv2d(given, made, 4, stride, 1, bias=bias)]
    return nn.Sequential(*layers, *([nn.BatchNorm2d(made)] if norm else []))


class UNet(nn.Module):
    """The generator: halvings down to 1 pixel, at most DEEPEST, and back, each beside its
    counterpart.
    """

    def __init__(self, config: TranslationConfig) -> None:
        super().__init__()
        depth = min(DEEPEST, config.side.bit_length() - 1)
        widths = [config.channels * min(8, 2**level) for level in range(depth)]
        self.down = nn.ModuleList(
            _down(given, made, 2, norm=0 < level < depth - 1)
            for level, (given, made) in enumerate(zip([3, *widths], widths, strict=False))
        )
        self.up = nn.ModuleList()
        for level in reversed(range(depth)):
            given = widths[level] * (1 if level == depth - 1 else 2)
            if level == 0:
                self.up.append(nn.ConvTranspose2d(given, 3, 4, 2, 1))
                continue
            made, dropped = widths[level - 1], depth - 1 - DROPPED_BLOCKS <= level < depth - 1
            convolution = nn.ConvTranspose2d(given, made, 4, 2, 1, bias=False)
            layers: list[nn.Module] = [convolution, nn.BatchNorm2d(made)]
            self.up.append(nn.Sequential(*layers, nn.Dropout(DROPOUT if dropped else 0.0)))

    def forward(self, images_B3SS: Tensor) -> Tensor:
        """(B, 3, S, S) from -1 to 1 -> the same."""
        kept, inner = [], images_B3SS
        for level, down in enumerate(self.down):
            inner = down(F.leaky_relu(inner, LEAKY) if level else inner)
            kept.append(inner)
        for level, up in enumerate(self.up):
            skipped = kept[len(kept) - 1 - level]
            inner = up(F.relu(skipped if level == 0 else torch.cat([inner, skipped], 1)))
        return inner.tanh()


class PatchDiscriminator(nn.Module):
    """Whether each patch of 70 x 70 pixels of an image is real, beside the condition's."""

    def __init__(self, config: TranslationConfig) -> None:
        super().__init__()
        c = config.channels
        self.layers = nn.ModuleList(
            [
                _down(6, c, 2, norm=False, bias=True), _down(c, 2 * c, 2, norm=True),
                _down(2 * c, 4 * c, 2, norm=True), _down(4 * c, 8 * c, 1, norm=True),
            ]
        )  # fmt: skip
        self.verdict = nn.Conv2d(8 * c, 1, 4, 1, 1)

    def forward(self, condition_B3SS: Tensor, image_B3SS: Tensor) -> Tensor:
        """Two images (B, 3, S, S) -> logits (B, 1, h, w)."""
        inner = torch.cat([condition_B3SS, image_B3SS], 1)
        for layer in self.layers:
            inner = F.leaky_relu(layer(inner), LEAKY)
        verdict: Tensor = self.verdict(inner)
        return verdict


class TranslationTraining:
    """Both networks with their optimizers; a step updates the discriminator, then the generator."""

    def __init__(self, config: TranslationConfig, device: str = "cpu") -> None:
        self.config, self.device = config, device
        self.generator = UNet(config).to(device)
        self.discriminator = PatchDiscriminator(config).to(device)
        for module in (*self.generator.modules(), *self.discriminator.modules()):
            if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
                nn.init.normal_(module.weight, 0.0, 0.02)
        self.optimizers = [
            torch.optim.Adam(network.parameters(), config.rate, betas=(0.5, 0.999))
            for network in (self.discriminator, self.generator)
        ]

    def step(self, drone_B3SS: Tensor, satellite_B3SS: Tensor, scale: float) -> dict[str, float]:
        """One update of each network from bytes of the two views of the same places, at `scale`
        times the rate.
        """
        for optimizer in self.optimizers:
            optimizer.param_groups[0]["lr"] = scale * self.config.rate
        condition, real = (_to_signed(one.to(self.device)) for one in (drone_B3SS, satellite_B3SS))
        made = self.generator(condition)
        loss_d = _judged(self.discriminator(condition, real), 1.0) / 2
        loss_d = loss_d + _judged(self.discriminator(condition, made.detach()), 0.0) / 2
        self.optimizers[0].zero_grad(set_to_none=True)
        loss_d.backward()  # type: ignore[no-untyped-call]
        self.optimizers[0].step()
        adversarial = _judged(self.discriminator(condition, made), 1.0)
        distance = (made - real).abs().mean()
        self.optimizers[1].zero_grad(set_to_none=True)
        (adversarial + self.config.l1_weight * distance).backward()
        self.optimizers[1].step()
        losses = {"discriminator_loss": loss_d, "adversarial_loss": adversarial, "l1": distance}
        return {name: float(loss.detach()) for name, loss in losses.items()}

    @torch.no_grad()
    def translate(self, images_B3SS: Tensor) -> Tensor:
        """Bytes (B, 3, S, S) of UAV images, laid on the ground -> bytes that look like a
        satellite's, without dropout and by BatchNorm's running means [chosen].
        """
        self.generator.eval()
        made: Tensor = self.generator(_to_signed(images_B3SS.to(self.device)))
        self.generator.train()
        return ((made + 1) * 127.5).round().clamp(0, 255).to(torch.uint8).cpu()

    def state_dict(self) -> dict[str, Any]:
        """All that the next step depends on, besides the order of the data."""
        return {
            "generator": self.generator.state_dict(),
            "discriminator": self.discriminator.state_dict(),
            "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where `state` was taken."""
        self.generator.load_state_dict(state["generator"])
        self.discriminator.load_state_dict(state["discriminator"])
        for optimizer, saved in zip(self.optimizers, state["optimizers"], strict=True):
            optimizer.load_state_dict(saved)


def _to_signed(images: Tensor) -> Tensor:
    return images.float() / 127.5 - 1


def _judged(logits: Tensor, real: float) -> Tensor:
    return F.binary_cross_entropy_with_logits(logits, torch.full_like(logits, real))
