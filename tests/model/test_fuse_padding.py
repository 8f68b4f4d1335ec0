"""Padding that is fused into depthwise convolutions changes no embedding."""

import pytest
import torch

from model.backbones.efficientnet_lite import SameConv2d
from model.config import PVDAConfig
from model.inference.fuse_batchnorm import fuse_batchnorm
from model.inference.fuse_padding import fuse_padding
from model.pvda import FeatureEncoder


def strided(encoder: FeatureEncoder) -> list[int]:
    """Kernel sizes of the strided depthwise convolutions that pad by a copy."""
    return [
        module.kernel_size[0]
        for module in encoder.modules()
        if isinstance(module, SameConv2d) and module.stride[0] > 1 and module.groups > 1
    ]


@pytest.fixture(scope="module")
def encoder() -> FeatureEncoder:
    torch.manual_seed(0)
    config = PVDAConfig(
        backbone="efficientnet_lite0", width=0.25, image_size=64, parts=2, part_dim=8
    )
    return FeatureEncoder(config).eval()


@pytest.mark.parametrize("size", [64, 96])
def test_fused_padding_leaves_maps_as_they_are(encoder: FeatureEncoder, size: int) -> None:
    plain, fused = fuse_batchnorm(encoder), fuse_padding(fuse_batchnorm(encoder), size)
    assert (strided(plain), strided(fused)) == ([3, 5, 3], [])
    images_B3HW = torch.randint(0, 256, (2, 3, size, size), dtype=torch.uint8)
    with torch.no_grad():
        expected_BCHW, found_BCHW = plain(images_B3HW)[0], fused(images_B3HW)[0]
    scale = float(expected_BCHW.abs().max())
    assert scale > 0
    torch.testing.assert_close(found_BCHW, expected_BCHW, rtol=0, atol=1e-5 * scale)


def test_odd_sizes_keep_their_padding(encoder: FeatureEncoder) -> None:
    assert strided(fuse_padding(fuse_batchnorm(encoder), 72)) == [3, 5, 3]
