"""Heat regions: the cells of the maps grouped by how strongly they respond [FSRA, CAMP].

Shapes: B images, N cells, C channels, H x W cells, R regions.
"""

import torch
from torch import Tensor

from model.config import PVDAConfig
from model.parts.base import PartPooling


class HeatRegions(PartPooling):
    """R = parts - 1 regions, the hottest first, and the whole image last: the class token [FSRA],
    or the mean of all cells where the backbone has none [chosen].
    """

    def __init__(self, config: PVDAConfig, channels: int) -> None:
        """Raises ValueError for fewer than two parts."""
        super().__init__(config, channels)
        if config.parts < 2:
            raise ValueError(
                f"parts is {config.parts}, expected at least 2 for pooling {config.pooling}: its "
                "regions and the whole image; set --parts 4"
            )
        self.regions = config.parts - 1
        self.channels = (channels,) * config.parts
        self.least_cells = int(self.regions**0.5) + 1

    def forward(self, maps_BCHW: Tensor, token_BC: Tensor | None) -> list[Tensor]:
        """R + 1 parts, (B, C) each."""
        regions_BRC = heat_regions(maps_BCHW.flatten(2).transpose(1, 2), self.regions)
        whole_BC = maps_BCHW.mean((2, 3)) if token_BC is None else token_BC
        return [*regions_BRC.unbind(1), whole_BC]


def heat_regions(cells_BNC: Tensor, regions: int) -> Tensor:
    """The mean of each group of cells, (B, R, C), the hottest first.

    A cell's heat is the mean of its channels; a group has floor(N / R) cells, the last one the rest
    too. Gradients flow through the values, not through the order.
    """
    order_BN = cells_BNC.detach().mean(2).argsort(dim=1, descending=True)
    sorted_BNC = cells_BNC.gather(1, order_BN[:, :, None].expand_as(cells_BNC))
    size = cells_BNC.shape[1] // regions
    ends = [size * region for region in range(1, regions)]
    return torch.stack([group.mean(1) for group in sorted_BNC.tensor_split(ends, dim=1)], dim=1)
