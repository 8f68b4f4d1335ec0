"""What a training starts from: ImageNet's weights, the built-in encoder's, or a file's."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from model.checkpoint import Checkpoint, build_encoder, dumps, dumps_encoder, is_checkpoint, loads
from model.config import PVDAConfig
from model.errors import CheckpointError
from model.pvda import FeatureEncoder
from model.weights import builtin
from model.weights.packaged import imagenet_weights
from model.weights.start import load_start

SMALL = PVDAConfig(
    backbone="efficientnet_lite0", image_size=64, parts=2, part_dim=8, discriminator_channels=8
)
THIN = replace(SMALL, backbone="resnet18", width=0.25)


def checkpoint(network: PVDAConfig, seed: int = 0) -> Checkpoint:
    torch.manual_seed(seed)
    return Checkpoint(
        network=network,
        recipe={"name": "tiny", "augmentation": {"mirror": False}},
        locations=["0839"],
        epoch=3,
        history=[{"epoch": 1}],
        state={"modules": {"encoder": FeatureEncoder(network).state_dict()}},
    )


def test_start_imagenet_fills_the_backbone_alone() -> None:
    encoder = FeatureEncoder(SMALL)
    refined = encoder.refine[0].get_parameter("0.weight").clone()
    load_start(encoder, SMALL.backbone, "imagenet", None)
    stem = encoder.backbone.get_parameter("stem.conv.weight")
    assert torch.equal(stem, imagenet_weights(SMALL.backbone)["_conv_stem.weight"])
    assert torch.equal(encoder.refine[0].get_parameter("0.weight"), refined)
    with pytest.raises(CheckpointError, match="no package holds ImageNet weights of resnet18"):
        load_start(FeatureEncoder(THIN), "resnet18", "imagenet", None)


@pytest.mark.parametrize("ending", ["pt", "safetensors"])
def test_start_takes_a_checkpoint_of_another_image_size(tmp_path: Path, ending: str) -> None:
    trained = checkpoint(THIN, seed=1)
    data = dumps(trained) if ending == "pt" else dumps_encoder(trained)
    (tmp_path / f"run.{ending}").write_bytes(data)
    encoder = FeatureEncoder(replace(THIN, image_size=96))
    load_start(encoder, "resnet18", "random", str(tmp_path / f"run.{ending}"))
    for name, tensor in encoder.state_dict().items():
        torch.testing.assert_close(tensor, trained.encoder_weights[name], rtol=1e-3, atol=1e-3)
    other = FeatureEncoder(replace(THIN, part_dim=16))
    with pytest.raises(CheckpointError, match=r"of another network \(refine.* expected this reci"):
        load_start(other, "resnet18", "random", str(tmp_path / f"run.{ending}"))


def test_start_takes_public_weights(tmp_path: Path) -> None:
    public = {f"{name}": tensor + 1 for name, tensor in FeatureEncoder(THIN).backbone.state_dict()
              .items() if tensor.is_floating_point()}  # fmt: skip
    torch.save(public, tmp_path / "resnet.pth")
    encoder = FeatureEncoder(THIN)
    load_start(encoder, "resnet18", "random", str(tmp_path / "resnet.pth"))
    assert torch.equal(encoder.backbone.get_parameter("bn1.bias"), public["bn1.bias"])
    assert not is_checkpoint((tmp_path / "resnet.pth").read_bytes())


def test_exported_encoder_embeds_as_its_checkpoint() -> None:
    trained = checkpoint(SMALL)
    data = dumps_encoder(trained)
    found = loads(data, "x.safetensors")
    assert is_checkpoint(data)
    assert is_checkpoint(dumps(trained))
    assert (found.network, found.recipe, found.epoch) == (SMALL, trained.recipe, 3)
    assert len(data) < 0.6 * len(dumps(trained))
    images = torch.randint(0, 256, (4, 3, 64, 64), dtype=torch.uint8)
    with torch.no_grad():
        one, other = (build_encoder(each)(images)[1].flatten(1) for each in (trained, found))
    assert float(torch.cosine_similarity(one, other).min()) > 0.9999


@pytest.mark.parametrize("spoil", ["cut", "format", "shape"])
def test_damaged_encoder_file_is_named(spoil: str) -> None:
    data = dumps_encoder(checkpoint(THIN))
    if spoil == "cut":
        data = data[:-100]
    elif spoil == "format":
        data = data.replace(b'"format":"2"', b'"format":"9"')
    else:
        data = data.replace(b'\\"part_dim\\": 8', b'\\"part_dim\\": 9')
    with pytest.raises(CheckpointError, match=r"x\.safetensors is no encoder of format 2"):
        loads(data, "x.safetensors")


def test_builtin_encoder_is_small_and_loads() -> None:
    data = builtin.read_builtin()
    assert len(data) <= 16_000_000
    opened = loads(data, builtin.BUILTIN)
    assert opened.network.backbone == "efficientnet_lite0"
    assert opened.recipe["augmentation"]["mirror"] is False
    encoder = FeatureEncoder(opened.network)
    load_start(encoder, opened.network.backbone, "builtin", None)
    weight = encoder.refine[0].get_parameter("0.weight")
    assert torch.equal(weight, opened.encoder_weights["refine.0.0.weight"])


def test_builtin_missing_says_what_to_do(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(builtin, "PATH", tmp_path / "builtin.safetensors")
    with pytest.raises(CheckpointError, match=r"is missing, expected the built-in.*install it"):
        builtin.read_builtin()
