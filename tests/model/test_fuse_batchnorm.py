"""Folding computes the same, and the backbone that it folds keeps torchvision's names."""

import pytest
import torch
from torch import Tensor, nn

from model.backbones.resnet import ResNet
from model.config import PVDAConfig
from model.inference.fuse_batchnorm import fuse_batchnorm
from model.pvda import FeatureEncoder


def images(count: int) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, (count, 3, 64, 64), dtype=torch.uint8, generator=generator)


@torch.no_grad()
def test_fuse_computes_the_same_without_batchnorm(
    lively_encoder: FeatureEncoder,
) -> None:
    folded = fuse_batchnorm(lively_encoder)
    kinds = {type(module) for module in folded.modules()}
    assert not kinds & {nn.BatchNorm1d, nn.BatchNorm2d}
    for own, other in zip(folded(images(4)), lively_encoder(images(4)), strict=True):
        torch.testing.assert_close(own, other, rtol=1e-4, atol=1e-4)


@torch.no_grad()
def test_fuse_test_encoder_feels_every_batchnorm(
    lively_encoder: FeatureEncoder,
) -> None:
    expected_BPD = lively_encoder(images(2))[1]
    for module in lively_encoder.modules():
        if isinstance(module, nn.modules.batchnorm._BatchNorm):
            module.bias.add_(0.5)
            assert not torch.allclose(
                lively_encoder(images(2))[1], expected_BPD, rtol=1e-3, atol=1e-3
            )
            module.bias.sub_(0.5)


@torch.no_grad()
def test_fuse_bottleneck_blocks() -> None:
    torch.manual_seed(0)
    encoder = FeatureEncoder(
        PVDAConfig(backbone="resnet50", width=0.25, image_size=64, parts=2, part_dim=8)
    )
    encoder(images(4))  # statistics of a batch
    encoder.eval()
    torch.testing.assert_close(
        fuse_batchnorm(encoder)(images(4))[1], encoder(images(4))[1], rtol=1e-4, atol=1e-4
    )


def test_fuse_leaves_the_encoder_unchanged(lively_encoder: FeatureEncoder) -> None:
    before = {name: tensor.clone() for name, tensor in lively_encoder.state_dict().items()}
    fuse_batchnorm(lively_encoder)
    after = lively_encoder.state_dict()
    assert list(before) == list(after)
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert all(parameter.requires_grad for parameter in lively_encoder.parameters())


def test_fuse_rejects_training_mode(lively_encoder: FeatureEncoder) -> None:
    with pytest.raises(ValueError, match=r"is in training mode, .*; call eval\(\)"):
        fuse_batchnorm(lively_encoder.train())


@torch.no_grad()
def test_fuse_leaves_a_norm_that_follows_no_layer() -> None:
    """USAM's is of the difference to the mean of the neighbours."""
    encoder = FeatureEncoder(
        PVDAConfig(backbone="resnet18_usam", width=0.25, image_size=64, parts=2, part_dim=8)
    ).eval()
    folded = fuse_batchnorm(encoder)
    left = [name for name, module in folded.named_modules() if isinstance(module, nn.BatchNorm2d)]
    assert left == ["backbone.usam_1.norm", "backbone.usam_2.norm"]
    torch.testing.assert_close(folded(images(4))[1], encoder(images(4))[1], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "convolutions"),
    [("resnet18", 20), ("resnet34", 36), ("resnet50", 53), ("resnet101", 104)],
)
def test_backbone_relus_are_separate_modules(name: str, convolutions: int) -> None:
    """A quantiser tells them apart by the module. The names are torchvision's: nothing but
    convolutions and norms.
    """
    with torch.device("meta"):
        backbone = ResNet(name)
    shortcuts = sum(
        name.endswith("downsample")
        for name, module in backbone.named_modules()
        if module is not None
    )
    relus = [module for module in backbone.modules() if isinstance(module, nn.ReLU)]
    assert len(relus) == convolutions - shortcuts  # each convolution of the main path has one
    seen: list[nn.Module] = []
    for module in relus:
        module.register_forward_hook(lambda own, given, result: seen.append(own))
    backbone(torch.empty(1, 3, 64, 64, device="meta"))
    assert len(seen) == len({id(module) for module in seen}) == len(relus)
    assert not any("relu" in name for name in backbone.state_dict())
