"""Weights of MCCG and QDFL by their authors' names compute what the descriptions say."""

import re
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from model.backbones.dinov2_adapters import DINOv2Adapters
from model.checkpoint import build_encoder, loads
from model.errors import CheckpointError
from model.inference.embed import embed
from model.weights.qdfl import convert_qdfl
from tests.model.test_import_methods import (
    MEAN,
    STD,
    class_block,
    class_block_twin,
    convnext_maps,
    fsra_state,
    imported,
    timm_state,
)
from tests.model.test_qdfl import State, authors_names, heads_attend, linear, norm, twin_tokens

pytestmark = pytest.mark.slow

FACEBOOK = {
    r"model\.stem\.": "downsample_layers.0.", r"model\.head\.norm\.": "norm.",
    r"model\.stages\.(\d)\.downsample\.": r"downsample_layers.\1.",
    r"model\.stages\.(\d)\.blocks\.(\d+)\.conv_dw": r"stages.\1.\2.dwconv",
    r"model\.stages\.(\d)\.blocks\.(\d+)\.mlp\.fc": r"stages.\1.\2.pwconv",
    r"model\.stages\.(\d)\.blocks\.(\d+)\.": r"stages.\1.\2.",
}  # fmt: skip
"Beginnings of timm's names -> Facebook's."


def mccg_state() -> State:
    """Random weights by the names of MCCG's two_view_net with two gates, 5 places."""
    state = {}
    for key, tensor in timm_state().items():
        for pattern, foreign in FACEBOOK.items():
            key = re.sub(f"^{pattern}", foreign, key)
        if key != "logit_scale":
            squeezed = tensor.flatten(1) if "pwconv" in key and tensor.dim() == 4 else tensor
            state[f"model_1.convnext.{key}"] = squeezed
    state["model_1.convnext.head.weight"] = torch.zeros(1000, 768)
    state["model_1.convnext.head.bias"] = torch.zeros(1000)
    for gate in ("cw", "hc"):
        at = f"model_1.tri_layer.{gate}.conv."
        state |= {
            f"{at}conv.weight": torch.randn(1, 2, 7, 7) / 5, f"{at}bn.weight": torch.rand(1) + 0.5,
            f"{at}bn.bias": torch.randn(1), f"{at}bn.running_mean": torch.randn(1),
            f"{at}bn.running_var": torch.rand(1) + 0.5,
            f"{at}bn.num_batches_tracked": torch.tensor(7),
        }  # fmt: skip
    for name in ("classifier1", "classifier_mcb1", "classifier_mcb2"):
        state |= class_block(f"model_1.{name}.", 768)
    return state


def mccg_twin(state: State, images: Tensor) -> Tensor:
    """MCCG's parts (B, 3, 16) in eval mode, written from its description."""
    s = {key.removeprefix("model_1."): tensor for key, tensor in state.items()}
    maps = convnext_maps(timm_state(), images)
    parts = []
    for gate, block, summarised, left in (
        ("cw", "classifier_mcb1", 2, "bcw"), ("hc", "classifier_mcb2", 3, "bch"),
    ):  # fmt: skip
        at = f"tri_layer.{gate}.conv."
        summary = torch.stack([maps.amax(summarised), maps.mean(summarised)], 1)
        if left == "bch":  # its convolution sees height before channels
            summary = summary.transpose(2, 3)
        z = F.conv2d(summary, s[f"{at}conv.weight"], padding=3)[:, 0]
        z = (z - s[f"{at}bn.running_mean"]) / (s[f"{at}bn.running_var"] + 1e-5).sqrt()
        gates = torch.sigmoid(z * s[f"{at}bn.weight"] + s[f"{at}bn.bias"])
        letters = "bcw" if left == "bcw" else "bhc"
        gated = torch.einsum(f"bchw,{letters}->bchw", maps, gates)
        parts.append(class_block_twin(s, f"{block}.", gated.mean((2, 3))))
    weight, bias = s["convnext.norm.weight"], s["convnext.norm.bias"]
    whole = F.layer_norm(maps.mean((2, 3)), (768,), weight, bias, 1e-6)
    return torch.stack([*parts, class_block_twin(s, "classifier1.", whole)], 1)


@torch.no_grad()
def test_imported_mccg_embeds_as_its_test_loop(tmp_path: Path) -> None:
    state = mccg_state()
    checkpoint = loads(imported(tmp_path, state, "mccg").read_bytes())
    assert len(checkpoint.locations) == 5
    assert (checkpoint.network.image_size, checkpoint.network.parts) == (256, 3)
    images = torch.randint(0, 256, (2, 3, 256, 256), dtype=torch.uint8)
    found = embed(build_encoder(checkpoint), images, mirror=True)
    normalised = (images / 255 - MEAN) / STD
    g = mccg_twin(state, normalised) + mccg_twin(state, normalised.flip(3))
    expected = (F.normalize(g, dim=2) / 3**0.5).flatten(1)
    assert torch.allclose(found, expected, atol=2e-4)
    branches = checkpoint.state["modules"]["classifier"]
    assert torch.equal(branches["branches.2.bias"], state["model_1.classifier1.classifier.0.bias"])


def qdfl_state(trunk: State, channels: int) -> State:
    """Random weights by the names of QDFL's U1652_model over this DINOv2, 5 places."""
    torch.manual_seed(3)
    head: State = {
        "AQEU.fc.weight": torch.randn(512, channels, 1, 1) / channels**0.5,
        "AQEU.fc.bias": torch.randn(512) / 10, "AQEU.coarse.queries": torch.randn(1, 8, 512),
        "AQEU.query_remap.weight": torch.randn(2, 8), "AQEU.query_remap.bias": torch.randn(2),
        "gem_fusion.p": torch.tensor([3.2]),
        "AQEU.FFU.reweight.fc1.weight": torch.randn(170, 512) / 23,
        "AQEU.FFU.reweight.fc1.bias": torch.randn(170) / 10,
        "AQEU.FFU.reweight.fc2.weight": torch.randn(1536, 170) / 13,
        "AQEU.FFU.reweight.fc2.bias": torch.randn(1536) / 10,
    }  # fmt: skip
    for name in ("coarse.self_attn0", "coarse.self_attn", "coarse.cross_attn", "cross_attn"):
        head[f"AQEU.{name}.in_proj_weight"] = torch.randn(1536, 512) / 23
        head[f"AQEU.{name}.in_proj_bias"] = torch.randn(1536) / 10
        head[f"AQEU.{name}.out_proj.weight"] = torch.randn(512, 512) / 23
        head[f"AQEU.{name}.out_proj.bias"] = torch.randn(512) / 10
    for name in ("coarse.norm_x", "coarse.norm_q", "coarse.norm_out", "norm_q", "norm_out"):
        head[f"AQEU.{name}.weight"] = torch.rand(512) + 0.5
        head[f"AQEU.{name}.bias"] = torch.randn(512) / 10
    for cycle in ("cycle1", "cycle2"):
        head[f"AQEU.FFU.{cycle}.weight"] = torch.randn(512, 512, 1, 1) / 23
        head[f"AQEU.FFU.{cycle}.bias"] = torch.randn(512) / 10
        head[f"AQEU.FFU.{cycle}.offset"] = torch.zeros(1, 1024, 1, 1)
    for name, width in (
        ("classifier0", 512), ("classifier1", 512), ("token_classifier", channels),
        ("gem_feature_classifier", 512),
    ):  # fmt: skip
        head |= class_block(f"{name}.", width)
    named = {f"components.{key}": tensor for key, tensor in head.items()}
    return named | {f"backbone.model.{key}": tensor for key, tensor in trunk.items()}


def cycle_twin(s: State, at: str, maps: Tensor, dim: int) -> Tensor:
    """Channel i read ((i + 1) mod 3) - 1 cells further along `dim`, then a 1x1 convolution."""
    size = maps.shape[dim]
    shifted = torch.zeros_like(maps)
    for channel in range(maps.shape[1]):
        for cell in range(size):
            source = cell + (channel + 1) % 3 - 1
            if 0 <= source < size:
                target = shifted[:, channel].select(dim - 1, cell)
                target.copy_(maps[:, channel].select(dim - 1, source))
    weight = s[f"{at}.weight"][:, :, 0, 0]
    mixed: Tensor = torch.einsum("oi,bihw->bohw", weight, shifted)
    return mixed + s[f"{at}.bias"][:, None, None]


def qdfl_twin(state: State, images: Tensor) -> Tensor:
    """QDFL's parts (B, 4, 16) in eval mode, written from its description."""
    trunk = {k.removeprefix("backbone.model."): v for k, v in state.items()}
    s = {k.removeprefix("components."): v for k, v in state.items()}

    def attend(at: str, query: Tensor, cells: Tensor) -> Tensor:
        weights = s[f"AQEU.{at}.in_proj_weight"].chunk(3)
        biases = s[f"AQEU.{at}.in_proj_bias"].chunk(3)
        q, k, v = (
            x @ w.T + b for x, w, b in zip((query, cells, cells), weights, biases, strict=True)
        )
        return linear(s, f"AQEU.{at}.out_proj", heads_attend(q, k, v, 8))

    def normed(at: str, x: Tensor) -> Tensor:
        return norm(s, f"AQEU.{at}", x, 1e-5)

    tokens = twin_tokens(trunk, images, 12)
    x = tokens[:, 1:] @ s["AQEU.fc.weight"][:, :, 0, 0].T + s["AQEU.fc.bias"]
    xn = normed("coarse.norm_x", x + attend("coarse.self_attn0", x, x))
    q = s["AQEU.coarse.queries"].expand(len(x), -1, -1)
    q = normed("coarse.norm_q", q + attend("coarse.self_attn", q, q))
    qc = normed("coarse.norm_out", attend("coarse.cross_attn", q, xn))
    side = round(x.shape[1] ** 0.5)
    m = (xn + x).transpose(1, 2).reshape(len(x), 512, side, side)
    x1 = cycle_twin(s, "AQEU.FFU.cycle1", m, 3)
    x2 = cycle_twin(s, "AQEU.FFU.cycle2", m.transpose(2, 3), 2)
    a = linear(s, "AQEU.FFU.reweight.fc1", (x1 + x2 + m).mean((2, 3))).relu()
    a = linear(s, "AQEU.FFU.reweight.fc2", a).reshape(len(x), 512, 3).softmax(2)[..., None, None]
    xf = a[:, :, 0] * x1 + a[:, :, 1] * x2 + a[:, :, 2] * m + m
    qc = normed("norm_q", qc)
    qf = normed("norm_out", qc + attend("cross_attn", qc, xf.flatten(2).transpose(1, 2)))
    two = linear(s, "AQEU.query_remap", qf.transpose(1, 2))
    p = s["gem_fusion.p"]
    gem = F.normalize(xf.clamp(min=1e-7).pow(p).mean((2, 3)).pow(1 / p), dim=1)
    parts = {
        "classifier0": two[..., 0], "classifier1": two[..., 1],
        "token_classifier": tokens[:, 0], "gem_feature_classifier": gem,
    }  # fmt: skip
    return torch.stack([class_block_twin(s, f"{name}.", part) for name, part in parts.items()], 1)


@torch.no_grad()
@pytest.mark.parametrize("wrapped", [False, True])
def test_imported_qdfl_computes_as_its_description(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wrapped: bool
) -> None:
    monkeypatch.setitem(DINOv2Adapters.sizes, "dinov2_small_qdfl", (12, 2))
    torch.manual_seed(2)
    trunk = DINOv2Adapters("dinov2_small_qdfl")
    for parameter in trunk.parameters():
        parameter.add_(torch.randn_like(parameter) * 0.2)
    state = qdfl_state(authors_names(trunk), 12)
    saved = {"state_dict": state, "epoch": 160} if wrapped else state
    checkpoint = loads(imported(tmp_path, saved, "qdfl").read_bytes())
    network = checkpoint.network
    assert (network.backbone, network.image_size) == ("dinov2_small_qdfl", 280)
    assert len(checkpoint.locations) == 5
    images = torch.randint(0, 256, (2, 3, 56, 56), dtype=torch.uint8)
    _, found = build_encoder(checkpoint)(images)
    assert torch.allclose(found, qdfl_twin(state, (images / 255 - MEAN) / STD), atol=2e-3)
    with pytest.raises(CheckpointError, match=r"components\.AQEU\.coarse\.queries is missing"):
        convert_qdfl({k: v for k, v in state.items() if "coarse.queries" not in k}, "net.ckpt")


def test_import_of_other_networks_as_mccg_or_qdfl_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no two_view_net of MCCG: its names begin with"):
        imported(tmp_path, fsra_state(), "mccg")
    with pytest.raises(CheckpointError, match="no U1652_model of QDFL: its names begin with"):
        imported(tmp_path, mccg_state(), "qdfl")
    half = {key: one for key, one in mccg_state().items() if ".hc." not in key}
    with pytest.raises(CheckpointError, match=r"tri_layer\.hc\.conv\.conv\.weight is missing"):
        imported(tmp_path, half, "mccg")
