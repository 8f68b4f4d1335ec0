"""Queries: two vectors that learnt queries draw from the cells, the class token, and a generalised
mean of the cells [QDFL].

From the public code (Shuyu-Hu/QDFL; Hu, TGRS 2025). Shapes: B images, C channels, H x W cells, N
cells, E numbers of a cell within the pooling, Q queries, K = 3 branches.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.config import PVDAConfig
from model.parts.base import PartPooling, require_parts
from model.parts.global_pooling import generalised_mean

DIM, HEADS, QUERIES, VECTORS, GATE_DIM = 512, 8, 8, 2, 170
POWER_START, LEAST = 4.5, 1e-7
QUERY_STD = 1e-6


def shift_channels(maps_BEHW: Tensor, dim: int) -> Tensor:
    """Channel i moved along a dimension so that each cell sees the one ((i + 1) mod 3) - 1 cells
    further on; zeros come in from outside.
    """
    shifted_BEHW = maps_BEHW.clone()
    length = maps_BEHW.shape[dim]
    for first, target, source in ((1, 0, 1), (2, 1, 0)):  # reads at +1, at -1
        group = shifted_BEHW[:, first::3]
        group.zero_()
        moved = maps_BEHW[:, first::3].narrow(dim, source, length - 1)
        group.narrow(dim, target, length - 1).copy_(moved)
    return shifted_BEHW


class CycleFC(nn.Module):
    """A 1x1 convolution whose channels read neighbouring cells (Chen, ICLR 2022)."""

    def __init__(self, dim: int) -> None:
        """`dim`: the dimension of the maps along which neighbours are read."""
        super().__init__()
        self.dim, self.conv = dim, nn.Conv2d(DIM, DIM, 1)

    def forward(self, maps_BEHW: Tensor) -> Tensor:
        """(B, E, H, W) -> (B, E, H, W)."""
        out: Tensor = self.conv(shift_channels(maps_BEHW, self.dim))
        return out


class FeatureFusion(nn.Module):
    """Maps and their mixtures along both dimensions, weighted by what their mean says.

    The vertical mixture is of the transposed maps and stays transposed, as in the public code.
    """

    def __init__(self) -> None:
        super().__init__()
        self.horizontal, self.vertical = CycleFC(3), CycleFC(2)
        self.gate = nn.Sequential(nn.Linear(DIM, GATE_DIM), nn.ReLU(), nn.Linear(GATE_DIM, 3 * DIM))

    def forward(self, maps_BEHW: Tensor) -> Tensor:
        """(B, E, H, H) -> (B, E, H, H)."""
        across = self.horizontal(maps_BEHW)
        down = self.vertical(maps_BEHW.transpose(2, 3))
        branches_KBEHW = torch.stack([across, down, maps_BEHW])
        mean_BE = branches_KBEHW.sum(0).mean((2, 3))
        weights_BEK = self.gate(mean_BE).unflatten(1, (DIM, 3)).softmax(2)
        fused: Tensor = torch.einsum("kbehw,bek->behw", branches_KBEHW, weights_BEK)
        return fused + maps_BEHW


class Queries(PartPooling):
    """Four parts: two vectors of queries (B, E), the class token (B, C), a generalised mean (B, E)
    of length 1. For a backbone without a class token, the mean of the maps in its place [chosen].
    """

    def __init__(self, config: PVDAConfig, channels: int) -> None:
        super().__init__(config, channels)
        require_parts(config, 4)
        self.channels = (DIM, DIM, channels, DIM)
        self.reduce = nn.Conv2d(channels, DIM, 1)
        self.queries = nn.Parameter(torch.empty(1, QUERIES, DIM))
        nn.init.normal_(self.queries, std=QUERY_STD)
        names = ("cells", "queries_self", "queries_cells", "queries_fused")
        self.attention = nn.ModuleDict(
            {name: nn.MultiheadAttention(DIM, HEADS, batch_first=True) for name in names}
        )
        self.norm = nn.ModuleDict({name: nn.LayerNorm(DIM) for name in (*names, "before_fused")})
        self.fusion = FeatureFusion()
        self.combine = nn.Linear(QUERIES, VECTORS)
        self.power = nn.Parameter(torch.full((1,), POWER_START))
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.trunc_normal_(module.weight, std=0.02)
                nn.init.zeros_(module.bias)

    def forward(self, maps_BCHW: Tensor, token_BC: Tensor | None) -> list[Tensor]:
        """Two vectors, token, generalised mean. Raises ValueError for maps that are not square."""
        height, width = maps_BCHW.shape[2:]
        if height != width:
            raise ValueError(
                f"maps have {height} x {width} cells, expected square ones for pooling queries; "
                "use square images"
            )
        cells_BNE = self.reduce(maps_BCHW).flatten(2).transpose(1, 2)
        mixed_BNE = self._added("cells", cells_BNE, cells_BNE)
        fused_BEHW = self.fusion(
            (mixed_BNE + cells_BNE).transpose(1, 2).unflatten(2, (height, width))
        )
        start_BQE = self.queries.expand(maps_BCHW.shape[0], -1, -1)
        query_BQE = self._added("queries_self", start_BQE, start_BQE)
        drawn_BQE = self.norm["queries_cells"](self._attend("queries_cells", query_BQE, mixed_BNE))
        drawn_BQE = self.norm["before_fused"](drawn_BQE)
        drawn_BQE = self._added("queries_fused", drawn_BQE, fused_BEHW.flatten(2).transpose(1, 2))
        vectors_BE2 = self.combine(drawn_BQE.transpose(1, 2))
        mean_BE = F.normalize(generalised_mean(fused_BEHW, self.power, LEAST), dim=1)
        whole_BC = maps_BCHW.mean((2, 3)) if token_BC is None else token_BC
        return [*vectors_BE2.unbind(2), whole_BC, mean_BE]

    def _attend(self, name: str, query_BQE: Tensor, cells_BNE: Tensor) -> Tensor:
        found: Tensor = self.attention[name](query_BQE, cells_BNE, cells_BNE, need_weights=False)[0]
        return found

    def _added(self, name: str, query_BQE: Tensor, cells_BNE: Tensor) -> Tensor:
        """Attention beside a shortcut, then a norm."""
        found: Tensor = self.norm[name](query_BQE + self._attend(name, query_BQE, cells_BNE))
        return found
