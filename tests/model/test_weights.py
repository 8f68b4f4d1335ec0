"""torchvision's weights load by name; what does not fit is listed."""

from pathlib import Path

import pytest
import safetensors.torch
import torch
from torch import Tensor

from model.backbones.resnet import LAYOUTS, ResNet
from model.errors import CheckpointError
from model.weights.load import infer_backbone, load_backbone, read_state_dict


def tiny(seed: int) -> ResNet:
    torch.manual_seed(seed)
    return ResNet("resnet18", 0.25)


def foreign() -> dict[str, Tensor]:
    """As torchvision would save a network of this size."""
    return tiny(1).state_dict() | {"fc.weight": torch.ones(1000, 128), "fc.bias": torch.ones(1000)}


@pytest.mark.parametrize("name", ["resnet.pth", "resnet.safetensors"])
def test_load_backbone_drops_torchvisions_classifier(tmp_path: Path, name: str) -> None:
    path = str(tmp_path / name)
    if name.endswith(".safetensors"):
        safetensors.torch.save_file(foreign(), path)
    else:
        torch.save(foreign(), path)
    backbone, expected = tiny(0), foreign()
    load_backbone(backbone, read_state_dict(path), path)
    for key, tensor in backbone.state_dict().items():
        assert torch.equal(tensor, expected[key])


def test_load_backbone_without_batch_counts() -> None:
    old = {
        name: tensor
        for name, tensor in foreign().items()
        if not name.endswith("num_batches_tracked")
    }
    backbone = tiny(0)
    load_backbone(backbone, old, "old.pth")
    assert torch.equal(backbone.conv1.weight, foreign()["conv1.weight"])


def test_load_backbone_lists_all_mismatches() -> None:
    state = foreign() | {
        "conv1.weight": torch.ones(16, 3, 3, 3),
        "module.bn1.weight": torch.ones(16),
    }
    del state["bn1.bias"]
    backbone = tiny(0)
    with pytest.raises(CheckpointError) as caught:
        load_backbone(backbone, state, "strange.pth")
    message = str(caught.value)
    assert message.startswith("strange.pth does not fit this backbone: ")
    for fault in (
        "bn1.bias is missing",
        "module.bn1.weight is unexpected",
        "conv1.weight is (16, 3, 3, 3) and not (16, 3, 7, 7)",
    ):
        assert fault in message
    assert "fc." not in message
    untouched = tiny(0).state_dict()
    for key, tensor in backbone.state_dict().items():
        assert torch.equal(tensor, untouched[key])


def test_read_state_dict_absent_file_names_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no weights at .*none\.pth; expected .*torchvision"):
        read_state_dict(str(tmp_path / "none.pth"))


@pytest.mark.parametrize("name", ["broken.pth", "broken.safetensors"])
def test_read_state_dict_rejects_damaged_file(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"not weights at all")
    with pytest.raises(
        CheckpointError, match=rf"{name} is no state dict \(.*expected \.pth or \.safetensors"
    ):
        read_state_dict(str(tmp_path / name))


@pytest.mark.parametrize(
    "value", [[1, 2], torch.ones(3), {"student": {"conv1.weight": torch.ones(1)}, "epoch": 3}]
)
def test_read_state_dict_rejects_other_content(tmp_path: Path, value: object) -> None:
    torch.save(value, tmp_path / "else.pth")
    with pytest.raises(
        CheckpointError, match=r"else\.pth has other values than tensors by name.*save model"
    ):
        read_state_dict(str(tmp_path / "else.pth"))


def test_read_state_dict_rejects_a_folder(tmp_path: Path) -> None:
    with pytest.raises(
        CheckpointError, match=r"is no state dict \(.*directory.*expected \.pth or \.safetensors"
    ):
        read_state_dict(str(tmp_path))


def published(backbone: str) -> dict[str, Tensor]:
    """Names and shapes of torchvision's ResNet of that depth, without memory."""
    with torch.device("meta"):
        fc = {
            "fc.weight": torch.empty(1000, 512 if backbone in ("resnet18", "resnet34") else 2048),
            "fc.bias": torch.empty(1000),
        }
        return ResNet(backbone).state_dict() | fc


@pytest.mark.parametrize(
    ("name", "tensors"),
    [("resnet18", 122), ("resnet34", 218), ("resnet50", 320), ("resnet101", 626)],
)
def test_load_backbone_of_each_depth(name: str, tensors: int) -> None:
    state = published(name)
    assert len(state) == tensors  # as torchvision's have them, the classifier's two included
    assert infer_backbone(state, "resnet.pth") == (name, 1.0)
    with torch.device("meta"):
        backbone = ResNet(name)
    load_backbone(backbone, state, "resnet.pth")


@pytest.mark.slow
@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize("other", LAYOUTS)
def test_load_backbone_rejects_another_depth(name: str, other: str) -> None:
    with torch.device("meta"):
        backbone = ResNet(name)
    if name == other:
        load_backbone(backbone, published(other), "resnet.pth")
        return
    with pytest.raises(
        CheckpointError,
        match=r"does not fit this backbone: .*layer.*; choose the --backbone that it was made",
    ):
        load_backbone(backbone, published(other), "resnet.pth")


def test_measure_backbone_finds_width_or_rejects() -> None:
    assert infer_backbone(foreign(), "thin.pth") == ("resnet18", 0.25)
    resnet152 = published("resnet101") | {
        f"layer2.{block}.conv3.weight": torch.ones(1) for block in range(4, 8)
    }
    with pytest.raises(
        CheckpointError,
        match=r"deep\.pth is of no backbone that we build: .* 3, 8, 23, 3 bottleneck blocks",
    ):
        infer_backbone(resnet152, "deep.pth")
    with pytest.raises(
        CheckpointError, match=r"conv1\.weight is missing, .*names begin with encoder_q\.conv1\.wei"
    ):
        infer_backbone(
            {f"encoder_q.{key}": tensor for key, tensor in foreign().items()}, "wrapped.pth"
        )
    with pytest.raises(CheckpointError, match="begin with nothing"):
        infer_backbone({}, "empty.pth")
