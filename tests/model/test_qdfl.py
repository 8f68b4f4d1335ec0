"""QDFL's frozen DINOv2 with adapters and its queries, against loops and a functional twin."""

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.backbones.dinov2_adapters import DINOv2Adapters, resample_bicubic
from model.backbones.vit import FSRAViT
from model.config import PVDAConfig
from model.errors import CheckpointError
from model.parts.queries import CycleFC, Queries
from model.two_views import EncoderWithClassifier
from model.weights.load import infer_backbone, load_backbone

CONFIG = PVDAConfig(
    backbone="dinov2_base_qdfl", image_size=224, pooling="queries", parts=4, dropout=0.5
)
State = dict[str, Tensor]


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> DINOv2Adapters:
    monkeypatch.setitem(DINOv2Adapters.sizes, "dinov2_small_qdfl", (12, 2))
    torch.manual_seed(0)
    backbone = DINOv2Adapters("dinov2_small_qdfl").eval()
    with torch.no_grad():
        for parameter in backbone.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.2)
    return backbone


def test_qdfl_has_the_published_parameters() -> None:
    with torch.device("meta"):
        model = EncoderWithClassifier(CONFIG, 701)
    counts = [(p.numel(), p.requires_grad) for p in model.parameters()]
    assert sum(count for count, _ in counts) == 108_868_785
    assert sum(count for count, trained in counts if trained) == 22_288_305
    with torch.device("meta"):
        small = DINOv2Adapters("dinov2_small_qdfl")
    trained = sum(p.numel() for p in small.parameters() if p.requires_grad)
    assert trained == 3_552_768
    assert sum(p.numel() for p in small.parameters()) == 22_056_576 + trained


def test_positions_at_native_size_are_unchanged() -> None:
    positions = torch.randn(1, 1 + 37 * 37, 4)
    assert resample_bicubic(positions, 37, 37) is positions
    for cells in (16, 20):
        found = resample_bicubic(positions, cells, cells)
        assert found.shape == (1, 1 + cells * cells, 4)
        assert torch.equal(found[:, 0], positions[:, 0])


def linear(state: State, at: str, x: Tensor) -> Tensor:
    return x @ state[f"{at}.weight"].T + state[f"{at}.bias"]


def norm(state: State, at: str, x: Tensor, eps: float) -> Tensor:
    centred = x - x.mean(-1, keepdim=True)
    deviation = (centred.square().mean(-1, keepdim=True) + eps).sqrt()
    return centred / deviation * state[f"{at}.weight"] + state[f"{at}.bias"]


def heads_attend(query: Tensor, key: Tensor, value: Tensor, heads: int) -> Tensor:
    pieces = []
    for q, k, v in zip(*(x.chunk(heads, -1) for x in (query, key, value)), strict=True):
        pieces.append((q @ k.transpose(1, 2) / q.shape[-1] ** 0.5).softmax(-1) @ v)
    return torch.cat(pieces, -1)


def twin_tokens(state: State, images: Tensor, blocks: int) -> Tensor:
    """DINOv2 with QDFL's adapters by the names of the authors' file."""
    x = F.conv2d(images, state["patch_embed.proj.weight"], state["patch_embed.proj.bias"], 14)
    height, width, dim = *x.shape[2:], x.shape[1]
    grid = state["pos_embed"][0, 1:].T.reshape(1, dim, 37, 37)
    grid = F.interpolate(
        grid, scale_factor=((height + 0.1) / 37, (width + 0.1) / 37), mode="bicubic"
    )
    x = (x + grid).flatten(2).transpose(1, 2)
    first = (state["cls_token"] + state["pos_embed"][:, :1]).expand(len(x), 1, dim)
    x = torch.cat([first, x], 1)
    for number in range(blocks):
        at = f"blocks.{number}"
        q, k, v = linear(state, f"{at}.attn.qkv", norm(state, f"{at}.norm1", x, 1e-6)).chunk(3, -1)
        y = linear(state, f"{at}.attn.proj", heads_attend(q, k, v, 2))
        inner = linear(state, f"{at}.adapter1.D_fc1", y).relu()
        x = x + state[f"{at}.ls1.gamma"] * (y + linear(state, f"{at}.adapter1.D_fc2", inner))
        h = norm(state, f"{at}.norm2", x, 1e-6)
        y = linear(state, f"{at}.mlp.fc2", F.gelu(linear(state, f"{at}.mlp.fc1", h)))
        inner = linear(state, f"{at}.adapter2.D_fc1", h).relu()
        y = y + 0.2 * linear(state, f"{at}.adapter2.D_fc2", inner)
        x = x + state[f"{at}.ls2.gamma"] * y
    return norm(state, "norm", x, 1e-6)


def authors_names(backbone: DINOv2Adapters) -> State:
    return {
        key.replace("embed.proj", "patch_embed.proj").removeprefix("embed."): tensor.detach()
        for key, tensor in backbone.state_dict().items()
    }


@torch.no_grad()
def test_dinov2_adapters_compute_as_their_twin(tiny: DINOv2Adapters) -> None:
    images_B3HW = torch.randn(2, 3, 42, 28)
    maps_BCHW, token_BC = tiny.features(images_B3HW)
    expected = twin_tokens(authors_names(tiny), images_B3HW, 12)
    assert token_BC is not None
    assert torch.allclose(token_BC, expected[:, 0], atol=1e-3)
    assert torch.allclose(maps_BCHW.flatten(2).transpose(1, 2), expected[:, 1:], atol=1e-3)


def test_only_adapters_have_gradients_and_freeze_counts(tiny: DINOv2Adapters) -> None:
    tiny(torch.randn(1, 3, 28, 28)).square().mean().backward()
    for name, parameter in tiny.named_parameters():
        assert (parameter.grad is not None) == (".adapter" in name)
    tiny.freeze(3)
    trained = {name for name, p in tiny.named_parameters() if p.requires_grad}
    assert {int(name.split(".")[1]) for name in trained} == set(range(2, 12))


@pytest.mark.parametrize("form", ["plain", "chunked", "without mask token"])
def test_dinov2_file_loads_by_its_names(tiny: DINOv2Adapters, form: str) -> None:
    state = {k: t + 1 for k, t in authors_names(tiny).items() if ".adapter" not in k}
    if form == "chunked":
        state = {key.replace("blocks.", "blocks.0."): tensor for key, tensor in state.items()}
    if form == "without mask token":
        del state["mask_token"]
    adapters = {k: t.clone() for k, t in tiny.state_dict().items() if ".adapter" in k}
    before = tiny.norm.weight.clone()
    assert infer_backbone(state, "dinov2.pth") == ("dinov2_small_qdfl", 1.0)
    load_backbone(tiny, state, "dinov2.pth")
    assert torch.equal(tiny.norm.weight, before + 1)
    assert all(torch.equal(tiny.state_dict()[key], tensor) for key, tensor in adapters.items())
    with pytest.raises(CheckpointError, match=r"norm.weight is missing"):
        load_backbone(tiny, {k: t for k, t in state.items() if k != "norm.weight"}, "half.pth")


def test_transformers_names_are_of_no_backbone() -> None:
    state = {"encoder.layer.0.attention.attention.query.weight": torch.zeros(1)}
    with pytest.raises(CheckpointError, match=r"no DINOv2 .*by the names of its own files"):
        infer_backbone(state, "model.safetensors")


@torch.no_grad()
@pytest.mark.parametrize("dim", [2, 3])
def test_cycle_fc_equals_a_loop(dim: int) -> None:
    layer, maps = CycleFC(dim), torch.randn(1, 512, 3, 4)
    shifted = torch.zeros_like(maps)
    for channel in range(512):
        offset = (channel + 1) % 3 - 1
        for row in range(3):
            for column in range(4):
                y, x = (row + offset, column) if dim == 2 else (row, column + offset)
                if 0 <= y < 3 and 0 <= x < 4:
                    shifted[0, channel, row, column] = maps[0, channel, y, x]
    weight, bias = layer.conv.weight[:, :, 0, 0], layer.conv.bias
    assert bias is not None
    expected = torch.einsum("oi,bihw->bohw", weight, shifted) + bias[:, None, None]
    assert torch.allclose(layer(maps), expected, atol=1e-5)


def twin_queries(state: State, maps: Tensor, fusion: nn.Module) -> list[Tensor]:
    """Steps 1 to 7 of QDFL's head but the fusion, which is a loop of its own above."""

    def attend(at: str, query: Tensor, cells: Tensor) -> Tensor:
        weights = state[f"attention.{at}.in_proj_weight"].chunk(3)
        biases = state[f"attention.{at}.in_proj_bias"].chunk(3)
        q, k, v = (
            x @ w.T + b for x, w, b in zip((query, cells, cells), weights, biases, strict=True)
        )
        return linear(state, f"attention.{at}.out_proj", heads_attend(q, k, v, 8))

    def normed(at: str, x: Tensor) -> Tensor:
        return norm(state, f"norm.{at}", x, 1e-5)

    x = torch.einsum("oi,bihw->bhwo", state["reduce.weight"][:, :, 0, 0], maps).flatten(1, 2)
    x = x + state["reduce.bias"]
    xn = normed("cells", x + attend("cells", x, x))
    q0 = state["queries"].expand(len(x), -1, -1)
    q = normed("queries_self", q0 + attend("queries_self", q0, q0))
    qc = normed("before_fused", normed("queries_cells", attend("queries_cells", q, xn)))
    side = maps.shape[-1]
    m = (xn + x).transpose(1, 2).reshape(len(x), 512, side, side)
    x1 = fusion.get_submodule("horizontal")(m)
    x2 = fusion.get_submodule("vertical")(m.permute(0, 1, 3, 2))
    g = linear(state, "fusion.gate.0", (x1 + x2 + m).mean((2, 3))).relu()
    a = linear(state, "fusion.gate.2", g).reshape(len(x), 512, 3).softmax(-1)[..., None, None]
    xf = a[:, :, 0] * x1 + a[:, :, 1] * x2 + a[:, :, 2] * m + m
    cells = xf.flatten(2).transpose(1, 2)
    qf = normed("queries_fused", qc + attend("queries_fused", qc, cells))
    two = torch.einsum("vq,bqe->vbe", state["combine.weight"], qf)
    two = two + state["combine.bias"][:, None, None]
    p = state["power"]
    gem = cells.clamp(min=1e-7).pow(p).mean(1).pow(1 / p)
    return [two[0], two[1], gem / gem.norm(dim=1, keepdim=True)]


@torch.no_grad()
def test_queries_compute_as_their_twin() -> None:
    torch.manual_seed(5)
    pooling = Queries(CONFIG, 24).eval()
    assert pooling.channels == (512, 512, 24, 512)
    for parameter in pooling.parameters():
        if parameter.numel() > 1:
            parameter.add_(torch.randn_like(parameter) * 0.05)
    maps_BCHW, token_BC = torch.randn(2, 24, 4, 4), torch.randn(2, 24)
    one, two, token, mean = pooling(maps_BCHW, token_BC)
    assert token is token_BC
    assert torch.equal(pooling(maps_BCHW, None)[2], maps_BCHW.mean((2, 3)))
    state = {key: tensor.detach() for key, tensor in pooling.state_dict().items()}
    expected = twin_queries(state, maps_BCHW, pooling.fusion)
    for found, wanted in zip((one, two, mean), expected, strict=True):
        assert torch.allclose(found, wanted, atol=1e-4)
    with pytest.raises(ValueError, match="maps have 4 x 3 cells, expected square ones"):
        pooling(maps_BCHW[..., :3], token_BC)


def test_every_parameter_of_queries_has_a_gradient() -> None:
    pooling = Queries(replace(CONFIG, dropout=0.0), 8)
    parts = pooling(torch.rand(2, 8, 3, 3), torch.rand(2, 8))
    (sum((part * torch.randn_like(part)).sum() for part in parts) + 0 * parts[0].sum()).backward()
    assert [name for name, p in pooling.named_parameters() if p.grad is None] == []


def test_fsra_and_dinov2_tell_each_other_apart() -> None:
    with pytest.raises(ValueError, match="8 blocks without biases"):
        FSRAViT.infer({"cls_token": torch.zeros(1, 1, 768)})
