"""What the encoder asks of a part pooling, and how one is built by its name.

In: a network's settings and the channels of its maps. Out: the module. Shapes: B images, C
channels, H x W cells, P parts, Ci numbers of part i.
"""

from importlib import import_module

from torch import Tensor, nn

from model.config import PVDAConfig
from model.parts import POOLINGS


class PartPooling(nn.Module):
    """Maps (B, C, H, W), and the class token (B, C) where there is one -> P vectors (B, Ci)."""

    channels: tuple[int, ...]
    "Ci of each part, in the order of the embedding."
    least_cells: int = 1
    "Cells a side of the smallest maps that it can divide."

    def __init__(self, config: PVDAConfig, channels: int) -> None:
        """Raises ValueError where it cannot make `config.parts` parts of maps of `channels`."""
        super().__init__()

    def forward(self, maps_BCHW: Tensor, token_BC: Tensor | None) -> list[Tensor]:
        """The parts, (B, Ci) each."""
        raise NotImplementedError


def require_parts(config: PVDAConfig, made: int) -> None:
    """Raise ValueError where a pooling that makes a fixed number of parts is asked for others."""
    if config.parts != made:
        raise ValueError(
            f"parts is {config.parts}, expected {made}, as many as pooling {config.pooling} makes; "
            f"set --parts {made}"
        )


def build_pooling(config: PVDAConfig, channels: int) -> PartPooling:
    """The pooling that `config` names, for maps of `channels`. Raises ValueError as its class."""
    module, _, kind = POOLINGS[config.pooling].partition(":")
    found: type[PartPooling] = getattr(import_module(module), kind)
    return found(config, channels)
