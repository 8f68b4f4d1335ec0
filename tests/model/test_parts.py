"""Part poolings and necks of the compared methods, against loops and hand-worked cases."""

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.backbones.base import build_backbone
from model.backbones.usam import USAM
from model.backbones.vit import FSRAViT, resample_positions
from model.config import PVDAConfig
from model.parts import POOLINGS
from model.parts.base import build_pooling
from model.parts.cross_gates import CrossGates
from model.parts.global_pooling import generalised_mean
from model.parts.heat_regions import HeatRegions, heat_regions
from model.parts.ring_attention import AttendedRings
from model.parts.ring_pooling import ring_average
from model.pvda import FeatureEncoder

PARTS = {
    "rings": 4,
    "mean": 1,
    "gem": 1,
    "heat_regions": 4,
    "cross_gates": 3,
    "attended_rings": 5,
    "queries": 4,
}
TINY = PVDAConfig(backbone="resnet18", width=0.25, image_size=128, part_dim=8)


def config_of(pooling: str) -> PVDAConfig:
    return replace(TINY, pooling=pooling, parts=PARTS[pooling])


@pytest.mark.parametrize("pooling", [name for name in POOLINGS if name != "queries"])
def test_pooling_makes_parts_of_its_channels(pooling: str) -> None:
    made = build_pooling(config_of(pooling), 6)(torch.randn(2, 6, 8, 8), None)
    assert [tuple(part.shape) for part in made] == [(2, 6)] * PARTS[pooling]
    encoder = FeatureEncoder(config_of(pooling)).eval()
    g_BPD = encoder(torch.zeros(2, 3, 128, 128, dtype=torch.uint8))[1]
    assert g_BPD.shape == (2, PARTS[pooling], 8)


@pytest.mark.parametrize("pooling", ["mean", "gem", "cross_gates", "heat_regions"])
def test_pooling_refuses_other_numbers_of_parts(pooling: str) -> None:
    parts = 1 if pooling == "heat_regions" else 7
    with pytest.raises(ValueError, match=rf"parts is {parts}, expected .*set --parts \d"):
        FeatureEncoder(replace(TINY, pooling=pooling, parts=parts))


def test_unknown_pooling_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="pooling is 'ring', expected one of rings, mean"):
        replace(TINY, pooling="ring")


def test_norm_neck_keeps_the_channels() -> None:
    network = replace(TINY, pooling="mean", parts=1, neck="norm", part_dim=128)
    encoder = FeatureEncoder(network)
    [neck] = encoder.refine
    assert isinstance(neck, nn.LayerNorm)
    with pytest.raises(ValueError, match=r"part_dim is 8, expected 128: .*set --part-dim 128"):
        FeatureEncoder(replace(network, part_dim=8))


def test_linear_ones_neck_starts_batchnorm_at_one() -> None:
    [neck] = FeatureEncoder(replace(TINY, pooling="mean", parts=1, neck="linear_ones")).refine
    assert bool((neck.get_parameter("1.weight") == 1).all())


def test_gem_is_the_mean_at_one_and_nears_the_largest() -> None:
    maps_BCHW = torch.rand(2, 3, 4, 4)
    mean = generalised_mean(maps_BCHW, torch.ones(3), 1e-6)
    assert torch.allclose(mean, maps_BCHW.mean((2, 3)), atol=1e-5)
    near = generalised_mean(maps_BCHW, torch.full((3,), 60.0), 1e-6)
    assert torch.allclose(near, maps_BCHW.amax((2, 3)), rtol=0.06)


def test_heat_regions_split_256_cells_in_85_85_86() -> None:
    heat_N = torch.randperm(256).float()
    cells_BNC = torch.stack([heat_N, heat_N], dim=1)[None]
    regions_BRC = heat_regions(cells_BNC, 3)
    hottest = torch.arange(255, -1, -1).float()
    expected = [hottest[:85].mean(), hottest[85:170].mean(), hottest[170:].mean()]
    assert regions_BRC[0, :, 0].tolist() == pytest.approx([float(mean) for mean in expected])


def test_heat_regions_end_with_token_or_mean() -> None:
    pooling = HeatRegions(config_of("heat_regions"), 5)
    maps_BCHW, token_BC = torch.randn(2, 5, 4, 4), torch.randn(2, 5)
    assert torch.equal(pooling(maps_BCHW, token_BC)[-1], token_BC)
    assert torch.equal(pooling(maps_BCHW, None)[-1], maps_BCHW.mean((2, 3)))


def gated_by_loops(maps: Tensor, conv: nn.Conv2d, axis: int) -> Tensor:
    """One image's maps (C, H, W), gated over channels and the axis that is not `axis`."""
    rest = 3 - axis
    channels, length, depth = maps.shape[0], maps.shape[rest], maps.shape[axis]
    summary = torch.zeros(1, 2, length, channels)
    for row in range(length):
        for channel in range(channels):
            line = maps.select(rest, row)[channel]
            summary[0, 0, row, channel], summary[0, 1, row, channel] = line.max(), line.mean()
    if axis == 1:  # over width: (C, W)
        summary = summary.transpose(2, 3)
    gate = conv(summary)[0, 0].sigmoid()
    gated = torch.empty_like(maps)
    for row in range(length):
        for channel in range(channels):
            weight = gate[channel, row] if axis == 1 else gate[row, channel]
            for at in range(depth):
                where = (channel, at, row) if axis == 1 else (channel, row, at)
                gated[where] = maps[where] * weight
    return gated


@torch.no_grad()
def test_cross_gates_equal_loops_over_cells() -> None:
    torch.manual_seed(3)
    pooling = CrossGates(config_of("cross_gates"), 3).eval()
    for gate in (pooling.over_width, pooling.over_height):
        gate.norm.eps = 0.0
    maps_BCHW = torch.randn(1, 3, 4, 5)
    width, height, whole = pooling(maps_BCHW, None)
    for found, gate, axis in ((width, pooling.over_width, 1), (height, pooling.over_height, 2)):
        expected = gated_by_loops(maps_BCHW[0], gate.conv, axis).mean((1, 2))
        assert torch.allclose(found[0], expected, atol=1e-5)
    assert torch.allclose(whole, F.layer_norm(maps_BCHW.mean((2, 3)), (3,), eps=1e-6))


def test_attended_rings_start_as_rings_and_the_whole() -> None:
    pooling = AttendedRings(config_of("attended_rings"), 16)
    maps_BCHW = torch.randn(2, 16, 8, 8)
    whole, *rings = pooling(maps_BCHW, None)
    assert torch.equal(whole, maps_BCHW.mean((2, 3)))
    assert torch.allclose(torch.stack(rings, 1), ring_average(maps_BCHW, 4, "ring"), atol=1e-5)


@torch.no_grad()
def test_usam_is_nine_times_the_difference_to_the_mean() -> None:
    module, maps_BCHW = USAM().eval(), torch.randn(2, 4, 6, 6)
    module.norm.eps = 0.0
    sums = F.pad(maps_BCHW.sum(1), (1, 1, 1, 1))
    expected = maps_BCHW.clone()
    for row in range(1, 5):
        for column in range(1, 5):
            window = sums[:, row : row + 3, column : column + 3]
            weight = (9 * sums[:, row + 1, column + 1] - window.sum((1, 2))).relu()
            expected[:, :, row, column] *= 1 + weight[:, None]
    assert torch.allclose(module(maps_BCHW), expected, atol=1e-4)


@pytest.mark.parametrize("name", ["resnet18_usam", "efficientnet_lite0_usam"])
def test_usam_stands_at_half_and_a_quarter_of_the_image(name: str) -> None:
    """In either family; nothing else of the backbone differs from the one without."""
    backbone, sides = build_backbone(name, 0.25).eval(), list[int]()
    for module in backbone.modules():
        if isinstance(module, USAM):
            module.register_forward_hook(lambda _, __, maps: sides.append(maps.shape[2]))
    assert backbone(torch.randn(1, 3, 64, 64)).shape[2:] == (4, 4)
    assert sides == [32, 16]
    plain = build_backbone(name.removesuffix("_usam"), 0.25)
    added = set(backbone.state_dict()) - set(plain.state_dict())
    assert {key.split(".")[0] for key in added} == {"usam_1", "usam_2"}


def test_usam_within_frozen_stages_learns_alone() -> None:
    """No public weights know it: kept as it starts, it would multiply the maps by any number."""
    backbone = build_backbone("efficientnet_lite0_usam", 0.25)
    backbone.freeze(len(backbone.stages()))
    backbone.train()
    before = {name: tensor.clone() for name, tensor in backbone.state_dict().items()}
    backbone(torch.rand(2, 3, 64, 64)).square().mean().backward()
    moved = {n for n, tensor in backbone.state_dict().items() if not torch.equal(tensor, before[n])}
    assert {name.split(".")[0] for name in moved} == {"usam_1", "usam_2"}
    learning = {name for name, one in backbone.named_parameters() if one.grad is not None}
    assert learning == {f"usam_{at}.norm.{what}" for at in (1, 2) for what in ("weight", "bias")}


@pytest.mark.slow
def test_fsra_backbone_has_a_token_beside_its_maps() -> None:
    maps_BCHW, token_BC = FSRAViT().eval().features(torch.zeros(1, 3, 32, 48))
    assert maps_BCHW.shape == (1, 768, 2, 3)
    assert token_BC is not None
    assert token_BC.shape == (1, 768)


def test_positions_of_the_own_grid_are_unchanged() -> None:
    positions_1ND = torch.randn(1, 257, 4)
    assert resample_positions(positions_1ND, 16, 16) is positions_1ND
    assert resample_positions(positions_1ND, 3, 5).shape == (1, 16, 4)
    flat = torch.ones(1, 17, 2)
    assert torch.equal(resample_positions(flat, 8, 8), torch.ones(1, 65, 2))
