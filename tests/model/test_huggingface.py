"""Backbones of transformers: sizes of the published networks, their maps, freezing and training.

Networks of the real sizes have no memory here; those that compute are small.
"""

import sys

import pytest
import torch
from torch import nn

from model.backbones import BACKBONES
from model.backbones.base import build_backbone
from model.checkpoint import Checkpoint, build_encoder, dumps, loads
from model.config import Optimization, PVDAConfig
from model.errors import CheckpointError, MissingLibrary
from model.inference.fuse_batchnorm import fuse_batchnorm
from model.inference.int8 import PrecisionError
from model.inference.optimise import optimise_encoder
from model.pvda import FeatureEncoder
from model.weights.load import infer_backbone
from tests.model.small_transformers import built, network_config
from tests.model.tiny_training import LOCATIONS, NOW, make

NAMES = [name for name, where in BACKBONES.items() if "huggingface" in where]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameters", "channels", "stride"),
    [
        ("vit_small", 21_665_664, 384, 16),
        ("vit_base", 85_798_656, 768, 16),
        ("dinov2_small", 22_056_576, 384, 14),
        ("dinov2_base", 86_580_480, 768, 14),
        ("dinov3_small", 21_596_544, 384, 16),
        ("convnext_tiny", 27_820_128, 768, 32),
        ("swin_tiny", 27_519_354, 768, 32),
    ],
)
def test_sizes_and_maps_as_published(
    name: str, parameters: int, channels: int, stride: int
) -> None:
    with torch.device("meta"):
        backbone = built(name).eval()
    assert sum(parameter.numel() for parameter in backbone.parameters()) == parameters
    images_B3HW = torch.empty(2, 3, 8 * stride, 9 * stride, device="meta")
    assert backbone.stride == stride
    assert backbone.channels == channels
    assert backbone(images_B3HW).shape == (2, channels, 8, 9)


def test_every_name_has_sizes_and_public_weights() -> None:
    for name in NAMES:
        with torch.device("meta"):
            kind = type(built(name))
        assert name in kind.sizes
        assert "/" in kind.hub_names[name]
    with pytest.raises(CheckpointError, match="transformers come as a folder"):
        infer_backbone({"embeddings.cls_token": torch.zeros(1)}, "vit.pth")


@torch.no_grad()
@pytest.mark.parametrize("small", ["vit_small", "dinov2_small", "dinov3_small"], indirect=True)
def test_cells_are_where_their_pixels_are(small: str) -> None:
    """A change of the image's lower left corner changes the maps there most."""
    backbone = built(small).eval()
    images_B3HW = torch.zeros(1, 3, 4 * backbone.stride, 6 * backbone.stride)
    before_BCHW = backbone(images_B3HW)
    images_B3HW[:, :, 3 * backbone.stride :, : backbone.stride] = 5.0
    change_HW = (backbone(images_B3HW) - before_BCHW).abs().sum((0, 1))
    assert int(change_HW.argmax()) == 3 * 6


def test_frozen_stages_stay_and_the_rest_learns(small: str) -> None:
    backbone = built(small)
    backbone.freeze(2)
    backbone.train()
    first, second, third = (layers[0] for layers in backbone.stages()[:3])
    assert not first.training
    assert not any(module.training for module in second.modules())
    assert third.training
    images_B3HW = torch.rand(2, 3, 2 * backbone.stride, 2 * backbone.stride)
    backbone(images_B3HW).square().mean().backward()
    frozen = {id(one) for stage in (first, second) for one in stage.parameters()}
    without = {n for n, p in backbone.named_parameters() if p.grad is None and id(p) not in frozen}
    assert without == {f"network.{name}" for name in backbone.unused} - {
        "network.embeddings.mask_token"
    }
    assert all(p.grad is None for p in backbone.parameters() if id(p) in frozen)
    count = len(backbone.stages())
    with pytest.raises(ValueError, match=f"frozen_stages is {count + 1}, expected 0 to {count}"):
        backbone.freeze(count + 1)


def test_every_trained_parameter_has_a_gradient(small: str) -> None:
    """DistributedDataParallel waits for the gradient of each."""
    backbone = built(small)
    images_B3HW = torch.rand(2, 3, 2 * backbone.stride, 2 * backbone.stride)
    (backbone(images_B3HW) * torch.randn(backbone.channels, 1, 1)).mean().backward()
    asked = {name: p.grad for name, p in backbone.named_parameters() if p.requires_grad}
    assert [name for name, gradient in asked.items() if gradient is None] == []


def test_training_step_and_checkpoint(small: str) -> None:
    config = network_config(small)
    training = make(config, Optimization(frozen_stages=1, optimizer="adamw"))
    side = config.image_size
    both_2B3HW = torch.randint(0, 256, (2, 3, 3, side, side), dtype=torch.uint8)
    drone_B3HW, satellite_B3HW = both_2B3HW.unbind()
    location_B = torch.arange(3) % LOCATIONS
    before = {n: t.clone() for n, t in training.model.encoder.state_dict().items()}
    metrics = training.step(drone_B3HW, location_B, satellite_B3HW, location_B, NOW)
    assert all(torch.isfinite(metric).all() for metric in metrics.values())
    after = training.model.encoder.state_dict()
    moved = {name for name in before if not torch.equal(before[name], after[name])}
    assert any(name.startswith("backbone.network") for name in moved)
    assert not any(".embeddings." in name for name in moved)
    data = dumps(
        Checkpoint(
            network=config, recipe={}, locations=["a"], epoch=1, history=[],
            state={"modules": {"encoder": after}},
        )
    )  # fmt: skip
    again = build_encoder(loads(data)).state_dict()
    assert all(torch.equal(again[name], after[name]) for name in after)


@torch.no_grad()
def test_fusing_leaves_the_backbone_and_computes_the_same(small: str) -> None:
    config = network_config(small)
    encoder = FeatureEncoder(config)
    images_B3HW = torch.randint(0, 256, (3, 3, *2 * (config.image_size,)), dtype=torch.uint8)
    encoder(images_B3HW)  # statistics of a batch
    folded = fuse_batchnorm(encoder.eval())
    assert not any(isinstance(one, nn.modules.batchnorm._BatchNorm) for one in folded.modules())
    for own, other in zip(folded(images_B3HW), encoder(images_B3HW), strict=True):
        torch.testing.assert_close(own, other, rtol=1e-4, atol=1e-4)


def test_optimise_fuses_in_float32_and_refuses_int8(small_vit: str) -> None:
    config = network_config(small_vit)
    encoder = FeatureEncoder(config).eval()
    images_B3HW = torch.randint(0, 256, (2, 3, *2 * (config.image_size,)), dtype=torch.uint8)
    fast = optimise_encoder(
        encoder, probe_B3HW=images_B3HW, batch_size=2, precision="float32", compiled=False
    )
    assert fast.kind == "folded"
    with pytest.raises(PrecisionError, match=r"the backbone is ViT; choose --precision float32"):
        optimise_encoder(
            encoder, probe_B3HW=images_B3HW, batch_size=2, precision="int8",
            calibration_B3HW=images_B3HW,
        )  # fmt: skip


def test_width_and_size_are_refused_in_a_sentence() -> None:
    with pytest.raises(ValueError, match=r"width is 0.5, expected 1 for vit_small.*--width 1"):
        build_backbone("vit_small", 0.5)
    with (
        torch.device("meta"),
        pytest.raises(ValueError, match=r"256 pixels.*multiple of 14.*--image-size 252 or 266"),
    ):
        FeatureEncoder(PVDAConfig(backbone="dinov2_small"))
    with torch.device("meta"):
        backbone = built("swin_tiny")
    with pytest.raises(ValueError, match="have 100 pixels a side, expected a multiple of 32"):
        backbone(torch.empty(1, 3, 128, 100, device="meta"))
    with pytest.raises(ValueError, match="192 pixels a side, expected at least 224 for swin_tiny"):
        backbone(torch.empty(1, 3, 256, 192, device="meta"))


def test_missing_library_names_the_command(small_vit: str, monkeypatch: pytest.MonkeyPatch) -> None:
    config = network_config(small_vit)
    state = {"modules": {"encoder": FeatureEncoder(config).state_dict()}}
    data = dumps(
        Checkpoint(network=config, recipe={}, locations=[], epoch=0, history=[], state=state)
    )
    monkeypatch.setitem(sys.modules, "transformers", None)
    for needs_it in (lambda: build_backbone(small_vit, 1.0), lambda: loads(data)):
        with pytest.raises(MissingLibrary, match=r"pip install 'pvda\[transformers\]'"):
            needs_it()
