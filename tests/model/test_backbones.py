"""The backbones: names, sizes and cost of the published networks."""

import pytest
import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from model.backbones.resnet import ResNet
from model.config import PVDAConfig
from model.pvda import FeatureEncoder, LocationClassifier, ViewDiscriminator


def on_meta(config: PVDAConfig) -> tuple[FeatureEncoder, LocationClassifier, ViewDiscriminator]:
    with torch.device("meta"):
        encoder = FeatureEncoder(config)
        return (
            encoder,
            LocationClassifier(config, 701),
            ViewDiscriminator(config, encoder.backbone.channels),
        )


def parameters(*modules: nn.Module) -> int:
    return sum(parameter.numel() for module in modules for parameter in module.parameters())


def torchvision_resnet50() -> dict[str, tuple[int, ...]]:
    """Names and shapes of torchvision's resnet50().state_dict() without `fc`, written by hand."""
    found: dict[str, tuple[int, ...]] = {}

    def convolution(name: str, outside: int, inside: int, side: int) -> None:
        found[f"{name}.weight"] = (outside, inside, side, side)

    def norm(name: str, channels: int) -> None:
        for tensor in ("weight", "bias", "running_mean", "running_var"):
            found[f"{name}.{tensor}"] = (channels,)
        found[f"{name}.num_batches_tracked"] = ()

    convolution("conv1", 64, 3, 7)
    norm("bn1", 64)
    inside = 64
    for layer, (blocks, width) in enumerate([(3, 64), (4, 128), (6, 256), (3, 512)], start=1):
        for block in range(blocks):
            name = f"layer{layer}.{block}"
            convolution(f"{name}.conv1", width, inside, 1)
            norm(f"{name}.bn1", width)
            convolution(f"{name}.conv2", width, width, 3)
            norm(f"{name}.bn2", width)
            convolution(f"{name}.conv3", 4 * width, width, 1)
            norm(f"{name}.bn3", 4 * width)
            if block == 0:
                convolution(f"{name}.downsample.0", 4 * width, inside, 1)
                norm(f"{name}.downsample.1", 4 * width)
            inside = 4 * width
    return found


def test_resnet50_has_torchvisions_names_and_shapes() -> None:
    with torch.device("meta"):
        own = {
            name: tuple(tensor.shape) for name, tensor in ResNet("resnet50").state_dict().items()
        }
    wanted = torchvision_resnet50()
    assert len(wanted) == 318
    assert own == wanted


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("resnet18", 11_176_512),
        ("resnet34", 21_284_672),
        ("resnet50", 23_508_032),
        ("resnet101", 42_500_160),
    ],
)
def test_resnet_parameter_counts_as_published(name: str, count: int) -> None:
    with torch.device("meta"):
        assert parameters(ResNet(name)) == count


def test_resnet_layer4_has_stride_1_without_dilation() -> None:
    with torch.device("meta"):
        modules = dict(ResNet("resnet50").named_modules())
    strided = {
        name
        for name, module in modules.items()
        if isinstance(module, nn.Conv2d) and module.stride != (1, 1)
    }
    assert strided == {
        "conv1",
        "layer2.0.conv2",
        "layer2.0.downsample.0",
        "layer3.0.conv2",
        "layer3.0.downsample.0",
    }
    assert all(
        module.dilation == (1, 1) for module in modules.values() if isinstance(module, nn.Conv2d)
    )


@pytest.mark.parametrize(("size", "cells", "giga_macs"), [(256, 16, 8.1), (384, 24, 18.2)])
def test_resnet_maps_have_stride_16_and_known_flops(
    size: int, cells: int, giga_macs: float
) -> None:
    encoder = on_meta(PVDAConfig(image_size=size))[0].eval()
    photo_B3HW = torch.empty(1, 3, size, size, dtype=torch.uint8, device="meta")
    with FlopCounterMode(display=False) as counter:
        maps_BCHW, g_BPD = encoder(photo_B3HW)
    assert maps_BCHW.shape == (1, 2048, cells, cells)
    assert g_BPD.shape == (1, 4, 512)
    assert counter.get_total_flops() / 2e9 == pytest.approx(giga_macs, abs=0.05)
