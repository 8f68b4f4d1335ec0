"""FSRA's vision transformer: 8 blocks of 768 numbers, the first `vit_small_patch16_224` of timm.

In: normalised images (B, 3, H, W), sides a multiple of 16. Out: feature maps (B, 768, H/16, W/16)
and the class token. From the public code (Dmmm1997/FSRA). Other transformers are in
`huggingface.py`; this one scales its attention by the width and not by a head's, and drops paths.
`dinov2_adapters.py` shares its attention, MLP and `TokenBackbone`.
Shapes: B images, N tokens with the class token first, D numbers of a token, h x w cells.
"""

import math
from typing import ClassVar, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.backbones.base import Backbone, Features

DEPTH, DIM, HEADS, MLP_DIM, PATCH = 8, 768, 8, 2304, 16
GRID = 16
"Positions a side: those of 256 px, at which FSRA trains; others are interpolated."
DROP_PATH, NORM_EPS = 0.1, 1e-6


class Embedding(nn.Module):
    """Images -> tokens: patches, the class token before them, positions."""

    def __init__(self) -> None:
        super().__init__()
        self.cls_token = nn.Parameter(torch.empty(1, 1, DIM))
        self.pos_embed = nn.Parameter(torch.empty(1, 1 + GRID * GRID, DIM))
        self.proj = nn.Conv2d(3, DIM, PATCH, PATCH)
        for parameter in (self.cls_token, self.pos_embed):
            nn.init.trunc_normal_(parameter, std=0.02)

    def forward(self, images_B3HW: Tensor) -> Tensor:
        """(B, 3, H, W) -> (B, N, D)."""
        cells_BDhw = self.proj(images_B3HW)
        patches_BND = cells_BDhw.flatten(2).transpose(1, 2)
        tokens_BND = torch.cat(
            [self.cls_token.expand(patches_BND.shape[0], -1, -1), patches_BND], 1
        )
        return tokens_BND + resample_positions(self.pos_embed, *cells_BDhw.shape[2:])


def resample_positions(positions_1ND: Tensor, height: int, width: int) -> Tensor:
    """Positions of a square grid, the class token's first, for another grid: bilinear, as FSRA's
    code; the same where the grid is.
    """
    side = math.isqrt(positions_1ND.shape[1] - 1)
    if (height, width) == (side, side):
        return positions_1ND
    grid_1Dhw = positions_1ND[:, 1:].reshape(1, side, side, -1).permute(0, 3, 1, 2)
    resized_1Dhw = F.interpolate(grid_1Dhw, (height, width), mode="bilinear", align_corners=False)
    return torch.cat([positions_1ND[:, :1], resized_1Dhw.flatten(2).transpose(1, 2)], dim=1)


class Attention(nn.Module):
    """Multi-head self-attention."""

    def __init__(self, dim: int, heads: int, *, bias: bool, scale: float) -> None:
        """`scale` multiplies the products of queries and keys; `bias` is theirs and the values'."""
        super().__init__()
        self.heads, self.scale = heads, scale
        self.qkv = nn.Linear(dim, 3 * dim, bias=bias)
        self.proj = nn.Linear(dim, dim)

    def forward(self, tokens_BND: Tensor) -> Tensor:
        """(B, N, D) -> (B, N, D)."""
        count, length, dim = tokens_BND.shape
        split = self.qkv(tokens_BND).reshape(count, length, 3, self.heads, dim // self.heads)
        query, key, value = split.permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(query, key, value, scale=self.scale)
        out: Tensor = self.proj(mixed.transpose(1, 2).reshape(count, length, dim))
        return out


class MLP(nn.Module):
    """Two linear layers with GELU between them."""

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(dim, hidden), nn.Linear(hidden, dim)

    def forward(self, tokens_BND: Tensor) -> Tensor:
        """(B, N, D) -> (B, N, D)."""
        out: Tensor = self.fc2(F.gelu(self.fc1(tokens_BND)))
        return out


class Block(nn.Module):
    """Attention and MLP, each after a norm and beside a shortcut; in training an image skips them
    at random.
    """

    def __init__(self, drop_path: float) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(DIM, NORM_EPS), nn.LayerNorm(DIM, NORM_EPS)
        self.attn = Attention(DIM, HEADS, bias=False, scale=DIM**-0.5)
        self.mlp, self.drop_path = MLP(DIM, MLP_DIM), drop_path

    def forward(self, tokens_BND: Tensor) -> Tensor:
        """(B, N, D) -> (B, N, D)."""
        tokens_BND = tokens_BND + self._drop(self.attn(self.norm1(tokens_BND)))
        return tokens_BND + self._drop(self.mlp(self.norm2(tokens_BND)))

    def _drop(self, path_BND: Tensor) -> Tensor:
        if not (self.training and self.drop_path):
            return path_BND
        kept_B11 = path_BND.new_empty(len(path_BND), 1, 1).bernoulli_(1 - self.drop_path)
        return path_BND * kept_B11 / (1 - self.drop_path)


class TokenBackbone(Backbone):
    """A plain transformer of `embed`, `blocks` and `norm`, its class token first; its stages are
    the embedding, each block, and the last norm.
    """

    foreign_names: ClassVar[dict[str, str]] = {
        r"embed\.proj": "patch_embed.proj", r"embed\.": "",
    }  # fmt: skip
    mean, std = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
    has_token = True
    quantizable = False
    embed: nn.Module
    blocks: nn.ModuleList
    norm: nn.LayerNorm

    def check_size(self, height: int, width: int) -> None:
        """Raises ValueError where a side is no multiple of the stride."""
        for side in (height, width):
            if side % self.stride or side < self.stride:
                lower = max(side // self.stride, 1) * self.stride
                raise ValueError(
                    f"images have {side} pixels a side, expected a multiple of {self.stride}; set "
                    f"--image-size {lower} or {lower + self.stride}"
                )

    def stages(self) -> list[list[nn.Module]]:
        """The embedding, each block, the last norm."""
        return [[self.embed], *([block] for block in self.blocks), [self.norm]]

    def features(self, images_B3HW: Tensor) -> Features:
        """Normalised images (B, 3, H, W) -> maps (B, D, h, w) and class token (B, D)."""
        self.check_size(*images_B3HW.shape[2:])
        height, width = (side // self.stride for side in images_B3HW.shape[2:])
        tokens_BND = super().forward(images_B3HW)
        cells_BDN = tokens_BND[:, 1:].transpose(1, 2)
        return Features(cells_BDN.reshape(*cells_BDN.shape[:2], height, width), tokens_BND[:, 0])

    def forward(self, images_B3HW: Tensor) -> Tensor:
        """Normalised images (B, 3, H, W) -> maps (B, D, H/stride, W/stride)."""
        return self.features(images_B3HW).maps_BCHW


class FSRAViT(TokenBackbone):
    """FSRA's transformer: 48,031,488 parameters."""

    stride = PATCH
    foreign_extra = ("head.", "fc.", "dist")
    channels = DIM

    def __init__(self) -> None:
        super().__init__()
        self.embed = Embedding()
        rates = torch.linspace(0, DROP_PATH, DEPTH, device="cpu").tolist()
        self.blocks = nn.ModuleList(Block(rate) for rate in rates)
        self.norm = nn.LayerNorm(DIM, NORM_EPS)
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.trunc_normal_(module.weight, std=0.02)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)

    @classmethod
    def build(cls, name: str, width: float) -> Self:
        """The network. Raises ValueError for a width other than 1."""
        if width != 1:
            raise ValueError(f"width is {width}, expected 1 for {name}; set --width 1")
        return cls()

    @classmethod
    def infer(cls, state: dict[str, Tensor]) -> tuple[str, float]:
        """Name and width of a state dict of this network. Raises ValueError for another."""
        qkv = state.get(f"blocks.{DEPTH - 1}.attn.qkv.weight")
        if qkv is None or qkv.shape != (3 * DIM, DIM) or "blocks.0.attn.qkv.bias" in state:
            raise ValueError(f"it is no transformer of {DEPTH} blocks without biases (FSRA)")
        return "vit_small_fsra", 1.0

    def adapt(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """Positions of another image size are interpolated to 256 px; a flat patch embedding gets
        its shape.
        """
        adapted = dict(state)
        if (positions := state.get("pos_embed")) is not None and positions.dim() == 3:
            adapted["pos_embed"] = resample_positions(positions, GRID, GRID)
        if (patches := state.get("patch_embed.proj.weight")) is not None and patches.dim() == 2:
            adapted["patch_embed.proj.weight"] = patches.reshape(-1, 3, PATCH, PATCH)
        return adapted
