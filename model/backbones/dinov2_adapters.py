"""DINOv2 whose weights stay as they are, with two adapters per block that learn [QDFL].

In: normalised images (B, 3, H, W), sides a multiple of 14. Out: feature maps (B, C, H/14, W/14) and
the class token, both after the last norm. From the public code (Shuyu-Hu/QDFL); without register
tokens. Names are those of DINOv2's own files. Shapes: B images, N tokens with the class token
first, D numbers of a token, h x w cells.
"""

import math
import re
from typing import ClassVar, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.backbones.vit import MLP, NORM_EPS, Attention, TokenBackbone

PATCH_SIDE, NATIVE_GRID = 14, 37
"NATIVE_GRID: positions a side, those of 518 px, at which DINOv2 was trained last."
MLP_RATIO, BLOCKS = 4, 12
ADAPTER_SHRINK, ADAPTER_SCALE = 2, 0.2
"An adapter has D / 2 numbers inside; that beside the MLP is multiplied by 0.2 [QDFL]."
DINOV2_SIZES = {"dinov2_small_qdfl": (384, 6), "dinov2_base_qdfl": (768, 12)}
"D and heads of the networks."


def resample_bicubic(positions_1ND: Tensor, height: int, width: int) -> Tensor:
    """Positions of a square grid, the class token's first, for another grid: bicubic by a factor
    of (cells + 0.1) / side, as DINOv2's code; the same where the grid is.
    """
    side = math.isqrt(positions_1ND.shape[1] - 1)
    if (height, width) == (side, side):
        return positions_1ND
    grid_1Dhw = positions_1ND[:, 1:].reshape(1, side, side, -1).permute(0, 3, 1, 2)
    # Without the .1 a cell may be lost. Python's numbers, also where the network is traced.
    factors = ((int(height) + 0.1) / side, (int(width) + 0.1) / side)
    resized_1Dhw = F.interpolate(grid_1Dhw, scale_factor=factors, mode="bicubic")
    return torch.cat([positions_1ND[:, :1], resized_1Dhw.flatten(2).transpose(1, 2)], dim=1)


class DINOv2Embedding(nn.Module):
    """Images -> tokens: patches, the class token before them, positions. The mask token is unused
    and stands here because public weights have it.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.cls_token = nn.Parameter(torch.zeros(1, 1, dim))
        self.mask_token = nn.Parameter(torch.zeros(1, dim))
        self.pos_embed = nn.Parameter(torch.empty(1, 1 + NATIVE_GRID * NATIVE_GRID, dim))
        self.proj = nn.Conv2d(3, dim, PATCH_SIDE, PATCH_SIDE)
        nn.init.trunc_normal_(self.pos_embed, std=0.02)

    def forward(self, images_B3HW: Tensor) -> Tensor:
        """(B, 3, H, W) -> (B, N, D)."""
        cells_BDhw = self.proj(images_B3HW)
        patches_BND = cells_BDhw.flatten(2).transpose(1, 2)
        tokens_BND = torch.cat(
            [self.cls_token.expand(patches_BND.shape[0], -1, -1), patches_BND], 1
        )
        return tokens_BND + resample_bicubic(self.pos_embed, *cells_BDhw.shape[2:])


class LayerScale(nn.Module):
    """One factor per number of a token."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(dim))

    def forward(self, tokens_BND: Tensor) -> Tensor:
        """(B, N, D) -> (B, N, D)."""
        return tokens_BND * self.gamma


class Adapter(nn.Module):
    """Two linear layers with ReLU between them, without a shortcut."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.D_fc1 = nn.Linear(dim, dim // ADAPTER_SHRINK)  # names of the public code
        self.D_fc2 = nn.Linear(dim // ADAPTER_SHRINK, dim)

    def forward(self, tokens_BND: Tensor) -> Tensor:
        """(B, N, D) -> (B, N, D)."""
        out: Tensor = self.D_fc2(F.relu(self.D_fc1(tokens_BND)))
        return out


class AdaptedBlock(nn.Module):
    """DINOv2's block: adapter1 follows the attention and is added to it, adapter2 stands beside
    the MLP.
    """

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(dim, NORM_EPS), nn.LayerNorm(dim, NORM_EPS)
        self.attn = Attention(dim, heads, bias=True, scale=(dim // heads) ** -0.5)
        self.mlp = MLP(dim, MLP_RATIO * dim)
        self.ls1, self.ls2 = LayerScale(dim), LayerScale(dim)
        self.adapter1, self.adapter2 = Adapter(dim), Adapter(dim)

    def forward(self, tokens_BND: Tensor) -> Tensor:
        """(B, N, D) -> (B, N, D)."""
        attended_BND = self.attn(self.norm1(tokens_BND))
        tokens_BND = tokens_BND + self.ls1(attended_BND + self.adapter1(attended_BND))
        normed_BND = self.norm2(tokens_BND)
        changed_BND = self.mlp(normed_BND) + ADAPTER_SCALE * self.adapter2(normed_BND)
        out: Tensor = tokens_BND + self.ls2(changed_BND)
        return out


class DINOv2Adapters(TokenBackbone):
    """DINOv2 of `sizes` with adapters. Only these have gradients: 14,183,424 of the base network's
    100,763,904 parameters.
    """

    stride = PATCH_SIDE
    foreign_extra = ("head.",)
    added = ("mask_token", *(f"blocks.{number}.adapter" for number in range(BLOCKS)))
    sizes: ClassVar[dict[str, tuple[int, int]]] = DINOV2_SIZES

    def __init__(self, name: str) -> None:
        super().__init__()
        self.channels, heads = self.sizes[name]
        self.embed = DINOv2Embedding(self.channels)
        self.blocks = nn.ModuleList(AdaptedBlock(self.channels, heads) for _ in range(BLOCKS))
        self.norm = nn.LayerNorm(self.channels, NORM_EPS)
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.trunc_normal_(module.weight, std=0.02)
                nn.init.zeros_(module.bias)
        for parameter_name, parameter in self.named_parameters():
            parameter.requires_grad_(".adapter" in parameter_name)

    @classmethod
    def build(cls, name: str, width: float) -> Self:
        """The network of that name. Raises ValueError for a width other than 1."""
        if width != 1:
            raise ValueError(f"width is {width}, expected 1 for {name}; set --width 1")
        return cls(name)

    @classmethod
    def infer(cls, state: dict[str, Tensor]) -> tuple[str, float]:
        """Name and width of a state dict with DINOv2's names. Raises ValueError for another."""
        token = state.get("cls_token")
        if token is not None and "blocks.0.ls1.gamma" in unchunked(state):
            for name, (dim, _) in cls.sizes.items():
                if token.shape[-1] == dim:
                    return name, 1.0
        raise ValueError("it is no DINOv2 of 384 or 768 numbers by the names of its own files")

    def adapt(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """Without the number of a chunk of blocks in the names of their tensors."""
        return unchunked(state)


def unchunked(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """`blocks.CHUNK.NUMBER.*` as `blocks.NUMBER.*`, as files of whole blocks name it."""
    return {
        re.sub(r"^blocks\.\d+\.(\d+)\.", r"blocks.\1.", key): tensor
        for key, tensor in state.items()
    }
