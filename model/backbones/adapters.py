"""DINOv2 with adapters: the public weights stay as they are, small networks beside them learn.

In: normalised images (B, 3, H, W), sides a multiple of 14. Out: feature maps (B, C, H/14, W/14) and
the class token. From the public code of QDFL (Shuyu-Hu/QDFL). Positions of other image sizes are
interpolated as the library `transformers` does it. Shapes: B images, N tokens, C channels.
"""

from typing import Any, ClassVar

import torch.nn.functional as F
from torch import Tensor, nn

from model.backbones.huggingface import DINOv2

SUFFIX = "_qdfl"
HIDDEN = 384
"Numbers within an adapter."
MLP_SHARE = 0.2
"Of the second adapter's output, beside the block's MLP."


class Adapter(nn.Module):
    """Two linear layers with ReLU between them."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.down, self.up = nn.Linear(channels, HIDDEN), nn.Linear(HIDDEN, channels)
        for layer in (self.down, self.up):
            nn.init.trunc_normal_(layer.weight, std=0.02)
            nn.init.zeros_(layer.bias)

    def forward(self, tokens_BNC: Tensor) -> Tensor:
        """(B, N, C) -> (B, N, C)."""
        out: Tensor = self.up(F.relu(self.down(tokens_BNC)))
        return out


class AttentionAdapter(Adapter):
    """Added to the output of a block's attention, of which it is made."""

    def after(self, module: nn.Module, given: Any, output: tuple[Tensor, Any]) -> Any:
        """The forward hook of the attention."""
        return output[0] + self(output[0]), *output[1:]


class MLPAdapter(Adapter):
    """Made of the input of a block's MLP, and added to its output with a small weight."""

    def after(self, module: nn.Module, given: tuple[Tensor], output: Tensor) -> Tensor:
        """The forward hook of the MLP."""
        added: Tensor = self(given[0])
        return output + MLP_SHARE * added


class AdaptedDINOv2(DINOv2):
    """DINOv2, frozen, with two adapters in each block: 14,183,424 parameters at 768 channels."""

    sizes: ClassVar[dict[str, dict[str, Any]]] = {
        name + SUFFIX: size for name, size in DINOv2.sizes.items()
    }
    hub_names: ClassVar[dict[str, str]] = {
        name + SUFFIX: hub for name, hub in DINOv2.hub_names.items()
    }

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.network.requires_grad_(False)
        blocks = list(self.network.get_submodule("encoder.layer").children())
        self.attention_adapters = nn.ModuleList(AttentionAdapter(self.channels) for _ in blocks)
        self.mlp_adapters = nn.ModuleList(MLPAdapter(self.channels) for _ in blocks)
        for block, attention, mlp in zip(
            blocks, self.attention_adapters, self.mlp_adapters, strict=True
        ):
            assert isinstance(attention, AttentionAdapter)
            assert isinstance(mlp, MLPAdapter)
            block.get_submodule("attention").register_forward_hook(attention.after)
            block.get_submodule("mlp").register_forward_hook(mlp.after)
