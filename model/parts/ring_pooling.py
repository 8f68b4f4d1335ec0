"""Square-ring pooling: maps -> one mean vector per ring, centre first.

Shapes: B images, C channels, H x W cells, P rings.
"""

import torch
from torch import Tensor

from model.config import Divisor, PVDAConfig
from model.parts.base import PartPooling


class Rings(PartPooling):
    """The mean of each square ring [LPN]."""

    def __init__(self, config: PVDAConfig, channels: int) -> None:
        super().__init__(config, channels)
        self.parts, self.divisor = config.parts, config.ring_divisor
        self.channels, self.least_cells = (channels,) * config.parts, 2 * config.parts

    def forward(self, maps_BCHW: Tensor, token_BC: Tensor | None) -> list[Tensor]:
        """P rings, (B, C) each, centre first."""
        return list(ring_average(maps_BCHW, self.parts, self.divisor).unbind(1))


def ring_masks(height: int, width: int, parts: int) -> Tensor:
    """Masks of the rings: (P, H, W) of 0 and 1, each cell in exactly one ring.

    Box i spans `[c - i*per, H - c + i*per)` with `c = H // 2`, `per = H // (2P)`, the last one the
    whole map; ring i is box i without box i-1. For even maps this is LPN's `[c - i*per, c +
    i*per)`; for odd and oblong ones it stays centred where LPN's code does not.

    Raises ValueError when the map is too small for that many rings.
    """
    if min(height, width) < 2 * parts:
        raise ValueError(
            f"maps of {height} x {width} cells cannot hold {parts} square rings; expected at least "
            f"{2 * parts} cells a "
            "side; use larger images or fewer parts"
        )
    rings = torch.full((height, width), parts - 1, dtype=torch.long)
    for part in reversed(range(parts - 1)):
        rings[_span(height, part + 1, parts), _span(width, part + 1, parts)] = part
    return (rings == torch.arange(parts)[:, None, None]).float()


def _span(size: int, box: int, parts: int) -> slice:
    centre, step = size // 2, size // (2 * parts)
    return slice(centre - box * step, size - centre + box * step)


def ring_average(maps_BCHW: Tensor, parts: int, divisor: Divisor = "box") -> Tensor:
    """Average of each ring's cells, (B, P, C).

    With `box` the sum over a ring is divided by the area of the box around it, as LPN's zero-filled
    boxes do (factors 1, .75, .556, .4375 of the true mean for P = 4 on 16 x 16 cells);
    with `ring` by the ring's own area.
    """
    masks_PHW = ring_masks(maps_BCHW.shape[2], maps_BCHW.shape[3], parts)
    areas_P = masks_PHW.sum((1, 2))
    weights_PHW = masks_PHW / (areas_P.cumsum(0) if divisor == "box" else areas_P)[:, None, None]
    weights_PHW = weights_PHW.to(maps_BCHW)
    return torch.einsum("bchw,phw->bpc", maps_BCHW, weights_PHW)
