"""Small networks of transformers under the names of published ones, and a folder of weights."""

from pathlib import Path
from typing import Any

import pytest
import torch

from model.backbones import huggingface
from model.backbones.base import build_backbone
from model.backbones.huggingface import HuggingFaceBackbone
from model.config import PVDAConfig

TOKENS = {"hidden_size": 16, "num_hidden_layers": 2, "num_attention_heads": 2}
SMALL: dict[str, tuple[type[HuggingFaceBackbone], dict[str, Any]]] = {
    "vit_small": (
        huggingface.ViT,
        TOKENS | {"intermediate_size": 32, "patch_size": 16, "image_size": 32},
    ),
    "dinov2_small": (huggingface.DINOv2, TOKENS | {"patch_size": 14, "image_size": 42}),
    "dinov3_small": (
        huggingface.DINOv3,
        TOKENS | {"intermediate_size": 32, "patch_size": 16, "num_register_tokens": 4},
    ),
    "convnext_tiny": (
        huggingface.ConvNeXt,
        {"hidden_sizes": [8, 8, 16, 16], "depths": [1, 1, 2, 1], "patch_size": 4},
    ),
    "swin_tiny": (
        huggingface.Swin,
        {
            "embed_dim": 8, "depths": [1, 1, 2, 1], "num_heads": [1, 1, 2, 2], "window_size": 2,
            "patch_size": 4,
        },
    ),
}  # fmt: skip
"Class and small sizes by a name of each class."


def use_small(name: str, monkeypatch: pytest.MonkeyPatch) -> str:
    family, sizes = SMALL[name]
    monkeypatch.setitem(family.sizes, name, sizes)
    torch.manual_seed(0)
    return name


def built(name: str) -> HuggingFaceBackbone:
    backbone = build_backbone(name, 1.0)
    assert isinstance(backbone, HuggingFaceBackbone)
    return backbone


def network_config(name: str) -> PVDAConfig:
    """The smallest images that two rings and D take."""
    size = 4 * SMALL[name][0].stride
    return PVDAConfig(
        backbone=name, image_size=size, parts=2, part_dim=8, dropout=0.0, discriminator_channels=8
    )


def saved(name: str, folder: Path) -> Path:
    """A folder of `save_pretrained` with another seed's weights; ConvNeXt's blocks are scaled up
    so that they count."""
    torch.manual_seed(7)
    network: Any = built(name).network
    with torch.no_grad():
        for key, parameter in network.named_parameters():
            parameter.copy_(torch.randn_like(parameter) * (1.0 if "layer_scale" in key else 0.2))
    network.save_pretrained(folder)
    return folder
