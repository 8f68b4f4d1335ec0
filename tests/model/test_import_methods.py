"""Weights of FSRA and Sample4Geo by their authors' names embed as their own test loops do."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from jobs.stages.import_weights import import_weights
from jobs.stages.settings import ImportWeightsSettings
from model.checkpoint import build_encoder, loads
from model.errors import CheckpointError
from model.inference.embed import embed
from pipeline.core.errors import InputError

pytestmark = pytest.mark.slow

MEAN, STD = (torch.tensor(v)[:, None, None] for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))


def class_block(head: str, channels: int) -> dict[str, Tensor]:
    """The lineage's classifier block with 16 numbers and 5 places, at the prefix `head`."""
    return {
        f"{head}add_block.0.weight": torch.randn(16, channels) / channels**0.5,
        f"{head}add_block.0.bias": torch.randn(16),
        f"{head}add_block.1.weight": torch.rand(16) + 0.5,
        f"{head}add_block.1.bias": torch.randn(16),
        f"{head}add_block.1.running_mean": torch.randn(16),
        f"{head}add_block.1.running_var": torch.rand(16) + 0.5,
        f"{head}classifier.0.weight": torch.randn(5, 16),
        f"{head}classifier.0.bias": torch.randn(5),
    }


def class_block_twin(state: dict[str, Tensor], head: str, part: Tensor) -> Tensor:
    """What the block makes of a part (B, C) in eval mode: (B, 16)."""
    b = f"{head}add_block"
    y = F.linear(part, state[f"{b}.0.weight"], state[f"{b}.0.bias"])
    deviation = (state[f"{b}.1.running_var"] + 1e-5).sqrt()
    scaled = (y - state[f"{b}.1.running_mean"]) / deviation * state[f"{b}.1.weight"]
    return scaled + state[f"{b}.1.bias"]


@cache
def fsra_state() -> dict[str, Tensor]:
    """Random weights by the names of FSRA's two_view_net with three heat regions, 5 places."""
    torch.manual_seed(0)
    trunk = {
        "cls_token": torch.randn(1, 1, 768), "pos_embed": torch.randn(1, 257, 768),
        "patch_embed.proj.weight": torch.randn(768, 3, 16, 16) / 28,
        "patch_embed.proj.bias": torch.randn(768), "norm.weight": torch.rand(768) + 0.5,
        "norm.bias": torch.randn(768), "fc.weight": torch.zeros(1000, 768),
        "fc.bias": torch.zeros(1000),
    }  # fmt: skip
    for block in range(8):
        for norm in ("norm1", "norm2"):
            trunk[f"blocks.{block}.{norm}.weight"] = torch.rand(768) + 0.5
            trunk[f"blocks.{block}.{norm}.bias"] = torch.randn(768) / 10
        trunk[f"blocks.{block}.attn.qkv.weight"] = torch.randn(2304, 768) / 28
        for layer, out, given in (
            ("attn.proj", 768, 768), ("mlp.fc1", 2304, 768), ("mlp.fc2", 768, 2304),
        ):  # fmt: skip
            trunk[f"blocks.{block}.{layer}.weight"] = torch.randn(out, given) / given**0.5
            trunk[f"blocks.{block}.{layer}.bias"] = torch.randn(out) / 10
    state = {f"model_1.transformer.{key}": tensor for key, tensor in trunk.items()}
    for name in ("classifier1", "classifier_heat1", "classifier_heat2", "classifier_heat3"):
        state |= class_block(f"model_1.{name}.", 768)
    return state


def fsra_twin(state: dict[str, Tensor], images: Tensor) -> Tensor:
    """FSRA's parts (B, 4, 16) in eval mode, written from its description: plain functions."""
    s = {key.removeprefix("model_1."): tensor for key, tensor in state.items()}
    t = {k.removeprefix("transformer."): v for k, v in s.items() if k.startswith("transformer.")}

    def norm(x: Tensor, name: str) -> Tensor:
        return F.layer_norm(x, (768,), t[f"{name}.weight"], t[f"{name}.bias"], 1e-6)

    patches = F.conv2d(images, t["patch_embed.proj.weight"], t["patch_embed.proj.bias"], stride=16)
    x = torch.cat([t["cls_token"].repeat(len(images), 1, 1), patches.flatten(2).mT], 1)
    x = x + t["pos_embed"]
    for block in range(8):
        b = f"blocks.{block}"
        heads = F.linear(norm(x, f"{b}.norm1"), t[f"{b}.attn.qkv.weight"])
        q, k, v = heads.view(len(x), -1, 3, 8, 96).permute(2, 0, 3, 1, 4)
        mixed = ((q @ k.mT) / 768**0.5).softmax(-1) @ v
        mixed = mixed.transpose(1, 2).flatten(2)
        x = x + F.linear(mixed, t[f"{b}.attn.proj.weight"], t[f"{b}.attn.proj.bias"])
        hidden = F.linear(norm(x, f"{b}.norm2"), t[f"{b}.mlp.fc1.weight"], t[f"{b}.mlp.fc1.bias"])
        x = x + F.linear(F.gelu(hidden), t[f"{b}.mlp.fc2.weight"], t[f"{b}.mlp.fc2.bias"])
    x = norm(x, "norm")
    parts = []
    for region in range(3):
        means = []
        for image in x[:, 1:]:
            order = image.mean(1).sort(descending=True).indices
            ends = (85 * region, 256 if region == 2 else 85 * (region + 1))
            means.append(image[order[ends[0] : ends[1]]].mean(0))
        parts.append((f"classifier_heat{region + 1}", torch.stack(means)))
    parts.append(("classifier1", x[:, 0]))
    return torch.stack([class_block_twin(s, f"{name}.", part) for name, part in parts], 1)


def imported(tmp_path: Path, state: Mapping[str, object], kind: str) -> Path:
    torch.save(state, tmp_path / "net.pth")
    flags = {kind: str(tmp_path / "net.pth"), "out": str(tmp_path / "out.pt")}
    return Path(import_weights(ImportWeightsSettings(**flags)))  # type: ignore[arg-type]


@torch.no_grad()
def test_imported_fsra_embeds_as_its_test_loop(tmp_path: Path) -> None:
    state = fsra_state()
    checkpoint = loads(imported(tmp_path, state, "fsra").read_bytes())
    assert len(checkpoint.locations) == 5
    assert (checkpoint.network.parts, checkpoint.network.part_dim) == (4, 16)
    images = torch.randint(0, 256, (2, 3, 256, 256), dtype=torch.uint8)
    found = embed(build_encoder(checkpoint), images, mirror=True)
    normalised = (images / 255 - MEAN) / STD
    g = fsra_twin(state, normalised) + fsra_twin(state, normalised.flip(3))
    expected = (F.normalize(g, dim=2) / 2).flatten(1)
    assert torch.allclose(found, expected, atol=2e-4)


@cache
def timm_state() -> dict[str, Tensor]:
    """Random weights by timm's names of ConvNeXt-T, as Sample4Geo saves them."""
    torch.manual_seed(1)
    dims, depths = (96, 192, 384, 768), (3, 3, 9, 3)
    state = {"stem.0.weight": torch.randn(96, 3, 4, 4) / 7, "stem.0.bias": torch.randn(96) / 10}

    def norm(name: str, size: int) -> None:
        state[f"{name}.weight"], state[f"{name}.bias"] = torch.rand(size) + 0.5, torch.zeros(size)

    norm("stem.1", 96)
    norm("head.norm", 768)
    for stage, (dim, depth) in enumerate(zip(dims, depths, strict=True)):
        if stage:
            before = dims[stage - 1]
            norm(f"stages.{stage}.downsample.0", before)
            weight = torch.randn(dim, before, 2, 2) / (4 * before) ** 0.5
            state[f"stages.{stage}.downsample.1.weight"] = weight
            state[f"stages.{stage}.downsample.1.bias"] = torch.randn(dim) / 10
        for block in range(depth):
            b = f"stages.{stage}.blocks.{block}"
            state[f"{b}.conv_dw.weight"] = torch.randn(dim, 1, 7, 7) / 7
            state[f"{b}.conv_dw.bias"] = torch.randn(dim) / 10
            norm(f"{b}.norm", dim)
            state[f"{b}.mlp.fc1.weight"] = torch.randn(4 * dim, dim, 1, 1) / dim**0.5
            state[f"{b}.mlp.fc1.bias"] = torch.randn(4 * dim) / 10
            state[f"{b}.mlp.fc2.weight"] = torch.randn(dim, 4 * dim) / (4 * dim) ** 0.5
            state[f"{b}.mlp.fc2.bias"] = torch.randn(dim) / 10
            state[f"{b}.gamma"] = torch.rand(dim) / 2
    named = {f"model.{key}": tensor for key, tensor in state.items()}
    return named | {"logit_scale": torch.tensor(2.7)}


def convnext_maps(state: dict[str, Tensor], images: Tensor) -> Tensor:
    """The maps (B, 768, H/32, W/32) of a ConvNeXt-T of timm: plain functions."""
    s = {key.removeprefix("model."): tensor for key, tensor in state.items()}

    def norm(x: Tensor, name: str) -> Tensor:
        over = x.permute(0, 2, 3, 1)
        over = F.layer_norm(over, over.shape[3:], s[f"{name}.weight"], s[f"{name}.bias"], 1e-6)
        return over.permute(0, 3, 1, 2)

    x = norm(F.conv2d(images, s["stem.0.weight"], s["stem.0.bias"], stride=4), "stem.1")
    for stage, depth in enumerate((3, 3, 9, 3)):
        if stage:
            b = f"stages.{stage}.downsample"
            x = F.conv2d(norm(x, f"{b}.0"), s[f"{b}.1.weight"], s[f"{b}.1.bias"], stride=2)
        for block in range(depth):
            b = f"stages.{stage}.blocks.{block}"
            weight, bias = s[f"{b}.conv_dw.weight"], s[f"{b}.conv_dw.bias"]
            y = norm(F.conv2d(x, weight, bias, padding=3, groups=x.shape[1]), f"{b}.norm")
            y = y.permute(0, 2, 3, 1)
            y = F.gelu(F.linear(y, s[f"{b}.mlp.fc1.weight"].flatten(1), s[f"{b}.mlp.fc1.bias"]))
            y = F.linear(y, s[f"{b}.mlp.fc2.weight"], s[f"{b}.mlp.fc2.bias"]) * s[f"{b}.gamma"]
            x = x + y.permute(0, 3, 1, 2)
    return x


def timm_twin(state: dict[str, Tensor], images: Tensor) -> Tensor:
    """The 768 numbers of a ConvNeXt-T of timm without its classifier."""
    weight, bias = state["model.head.norm.weight"], state["model.head.norm.bias"]
    return F.layer_norm(convnext_maps(state, images).mean((2, 3)), (768,), weight, bias, 1e-6)


@torch.no_grad()
def test_imported_sample4geo_embeds_as_its_test_loop(tmp_path: Path) -> None:
    state = timm_state()
    checkpoint = loads(imported(tmp_path, state, "sample4geo").read_bytes())
    assert (checkpoint.network.image_size, checkpoint.network.embedding_dim) == (384, 768)
    images = torch.randint(0, 256, (2, 3, 384, 384), dtype=torch.uint8)
    found = embed(build_encoder(checkpoint), images, mirror=False)
    expected = F.normalize(timm_twin(state, (images / 255 - MEAN) / STD), dim=1)
    assert torch.allclose(found, expected, atol=2e-4)


def test_import_of_another_networks_weights_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no name ends with patch_embed\.proj\.weight"):
        imported(tmp_path, timm_state(), "fsra")
    with pytest.raises(CheckpointError, match="no TimmModel of Sample4Geo: 0 blocks in stages"):
        imported(tmp_path, fsra_state(), "sample4geo")
    missing = "model.stages.1.blocks.0.gamma"
    cut = {key: tensor for key, tensor in timm_state().items() if key != missing}
    with pytest.raises(CheckpointError, match=r"stages\.1\.blocks\.0\.gamma is missing"):
        imported(tmp_path, cut, "sample4geo")
    with pytest.raises(InputError, match=r"--lpn and --fsra given, expected one of --torchvision"):
        ImportWeightsSettings(out="a", lpn="b", fsra="c")
