"""Square rings whose cells attend to each other, and the whole image: in the style of MSBA.

The paper says that blocks of several scales are attended within; how is not known. Chosen: one head
per ring, keys of C / 8 numbers, a residual that starts at zero. Shapes: B images, C channels, H x W
cells, P parts, N cells of a ring, K numbers of a key.
"""

import torch.nn.functional as F
from torch import Tensor, nn

from model.config import PVDAConfig
from model.parts.base import PartPooling
from model.parts.ring_pooling import ring_masks

SHRINK = 8
"Channels per number of a key."


class SelfAttention(nn.Module):
    """One head over a set of cells, added to them; zero at the start."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        keys = max(1, channels // SHRINK)
        self.query, self.key = nn.Linear(channels, keys), nn.Linear(channels, keys)
        self.value = nn.Linear(channels, channels)
        nn.init.zeros_(self.value.weight)
        nn.init.zeros_(self.value.bias)

    def forward(self, cells_BNC: Tensor) -> Tensor:
        """(B, N, C) -> (B, N, C)."""
        query_BNK, key_BNK = self.query(cells_BNC), self.key(cells_BNC)
        mixed: Tensor = F.scaled_dot_product_attention(query_BNK, key_BNK, self.value(cells_BNC))
        return cells_BNC + mixed


class AttendedRings(PartPooling):
    """The mean of the whole image, then the mean of each of P - 1 rings after attention."""

    def __init__(self, config: PVDAConfig, channels: int) -> None:
        """Raises ValueError for fewer than two parts."""
        super().__init__(config, channels)
        if config.parts < 2:
            raise ValueError(
                f"parts is {config.parts}, expected at least 2 for pooling {config.pooling}: the "
                "whole image and its rings; set --parts 5"
            )
        self.rings = config.parts - 1
        self.channels, self.least_cells = (channels,) * config.parts, 2 * self.rings
        self.attention = nn.ModuleList(SelfAttention(channels) for _ in range(self.rings))

    def forward(self, maps_BCHW: Tensor, token_BC: Tensor | None) -> list[Tensor]:
        """P parts, (B, C) each: the whole, then the rings from the centre."""
        masks_PN = ring_masks(maps_BCHW.shape[2], maps_BCHW.shape[3], self.rings).flatten(1) > 0
        cells_BNC = maps_BCHW.flatten(2).transpose(1, 2)
        rings = [
            attend(cells_BNC[:, mask_N.to(cells_BNC.device)]).mean(1)
            for attend, mask_N in zip(self.attention, masks_PN, strict=True)
        ]
        return [maps_BCHW.mean((2, 3)), *rings]
