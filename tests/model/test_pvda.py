"""The networks: sizes, names, strides and initial weights, mostly on the meta device, which
computes shapes only.

Shapes: B images, C channels of the maps, P rings, D numbers per ring, L locations.
"""

from typing import Literal

import pytest
import torch
from torch import Tensor, nn

from model.config import PVDAConfig
from model.inference.embed import embed, unit_embedding
from model.parts.necks import build_neck
from model.pvda import FeatureEncoder, LocationClassifier, ViewDiscriminator

PAPER = PVDAConfig()
TINY = PVDAConfig(
    backbone="resnet18", width=0.25, image_size=64, parts=2, part_dim=8, discriminator_channels=8
)


def on_meta(config: PVDAConfig) -> tuple[FeatureEncoder, LocationClassifier, ViewDiscriminator]:
    with torch.device("meta"):
        encoder = FeatureEncoder(config)
        return (
            encoder,
            LocationClassifier(config, 701),
            ViewDiscriminator(config, encoder.backbone.channels),
        )


def images(*shape: int, seed: int = 0) -> Tensor:
    return torch.randint(
        0, 256, shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(seed)
    )


def parameters(*modules: nn.Module) -> int:
    return sum(parameter.numel() for module in modules for parameter in module.parameters())


def test_networks_have_the_papers_sizes() -> None:
    encoder, classifier, discriminator = on_meta(PAPER)
    assert parameters(encoder) == 23_508_032 + 4 * (2048 * 512 + 512 + 2 * 512) == 27_708_480
    assert parameters(encoder, classifier) == 27_708_480 + 4 * (512 * 701 + 701) == 29_146_932
    assert (
        parameters(discriminator)
        == 9 * 1024 * (2048 + 1024 + 1024) + 3 * 2 * 1024 + 2050
        == 37_756_930
    )
    assert PAPER.embedding_dim == 2048


def test_discriminator_layers_as_in_figure_2() -> None:
    discriminator = on_meta(PAPER)[2]
    kinds = [
        type(module).__name__ for module in discriminator.modules() if not list(module.children())
    ]
    block = ["Conv2d", "BatchNorm2d"]
    assert kinds == [*block, *block, "AvgPool2d", *block, "AvgPool2d", "ReLU", "Linear"]
    convolutions = [module for module in discriminator.modules() if isinstance(module, nn.Conv2d)]
    assert [(c.in_channels, c.out_channels, c.kernel_size, c.padding) for c in convolutions] == [
        (inside, 1024, (3, 3), (1, 1)) for inside in (2048, 1024, 1024)
    ]


@pytest.mark.parametrize(("cells", "left"), [(16, 4), (24, 6)])
def test_discriminator_gives_one_verdict_per_image(cells: int, left: int) -> None:
    discriminator = on_meta(PAPER)[2]
    maps_BCHW = torch.empty(3, 2048, cells, cells, device="meta")
    assert discriminator.blocks(maps_BCHW).shape == (3, 1024, left, left)
    assert discriminator(maps_BCHW).shape == (3, 2)


@torch.no_grad()
def test_linear_neck_is_initialised_as_lpns() -> None:
    torch.manual_seed(0)
    neck = build_neck("linear", 2048, 512)
    assert isinstance(neck, nn.Sequential)
    linear, norm = neck
    assert isinstance(linear, nn.Linear)
    assert isinstance(norm, nn.BatchNorm1d)
    assert float(linear.weight.std()) == pytest.approx(
        (2 / 512) ** 0.5, rel=0.01
    )  # Kaiming over the 512 outputs
    assert float(linear.weight.mean()) == pytest.approx(0, abs=1e-3)
    assert float(norm.weight.mean()) == pytest.approx(1, abs=0.005)
    assert float(norm.weight.std()) == pytest.approx(0.02, rel=0.15)
    assert not linear.bias.any()
    assert not norm.bias.any()


@torch.no_grad()
def test_classifier_starts_with_equal_probabilities() -> None:
    torch.manual_seed(0)
    classifier = LocationClassifier(PAPER, 701)
    assert classifier.dropout.p == 0.75
    assert len(classifier.branches) == 4
    for branch in classifier.branches:
        assert isinstance(branch, nn.Linear)
        assert float(branch.weight.std()) == pytest.approx(0.001, rel=0.01)
        assert not branch.bias.any()


def test_classifier_drops_out_in_training_only() -> None:
    torch.manual_seed(0)
    classifier = LocationClassifier(PVDAConfig(part_dim=512), 3)
    g_BPD = torch.ones(1, 4, 512)
    seen: list[Tensor] = []
    classifier.dropout.register_forward_hook(lambda module, given, result: seen.append(result))
    classifier(g_BPD)
    classifier.eval()(g_BPD)
    assert float((seen[0] == 0).float().mean()) == pytest.approx(0.75, abs=0.04)
    assert torch.equal(seen[1], g_BPD)


def test_rings_have_own_refinement_and_classifier() -> None:
    torch.manual_seed(0)
    encoder, classifier = FeatureEncoder(TINY).eval(), LocationClassifier(TINY, 3).eval()
    photo_B3HW = images(1, 3, 64, 64)
    before_BPD, before_BPL = encoder(photo_B3HW)[1], classifier(torch.ones(1, 2, 8))
    with torch.no_grad():
        encoder.refine[1].get_parameter("0.bias").add_(1)
        classifier.branches[0].get_parameter("bias").add_(1)
    changed_BPD, changed_BPL = (
        encoder(photo_B3HW)[1] != before_BPD,
        classifier(torch.ones(1, 2, 8)) != before_BPL,
    )
    assert changed_BPD.any(2).tolist() == [[False, True]]
    assert changed_BPL.any(2).tolist() == [[True, False]]


def test_encoder_normalises_by_imagenet() -> None:
    encoder = FeatureEncoder(TINY).eval()
    seen: list[Tensor] = []
    encoder.backbone.register_forward_pre_hook(lambda module, given: seen.append(given[0]))
    encoder(
        torch.tensor([0, 128, 255], dtype=torch.uint8)[None, :, None, None].expand(1, 3, 64, 64)
    )
    expected = [(0 - 0.485) / 0.229, (128 / 255 - 0.456) / 0.224, (1 - 0.406) / 0.225]
    assert seen[0][0, :, 5, 7].tolist() == pytest.approx(expected, rel=1e-5)
    assert not {"mean_31", "std_31"} & set(encoder.state_dict())


@pytest.mark.parametrize("divisor", ["box", "ring"])
def test_encoder_takes_the_ring_divisor(divisor: Literal["box", "ring"]) -> None:
    torch.manual_seed(0)
    encoder = FeatureEncoder(PVDAConfig(**{**vars(TINY), "ring_divisor": divisor})).eval()
    seen: list[Tensor] = []
    encoder.refine[1].register_forward_pre_hook(lambda module, given: seen.append(given[0]))
    maps_BCHW, _ = encoder(images(1, 3, 64, 64))
    outer_BC = (maps_BCHW.sum((2, 3)) - maps_BCHW[:, :, 1:3, 1:3].sum((2, 3))) / {
        "box": 16,
        "ring": 12,
    }[divisor]
    torch.testing.assert_close(seen[0], outer_BC)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (
            {"image_size": 112},
            "image_size is 112, expected at least 128 pixels for 4 parts; use larger",
        ),
        ({"image_size": 48, "parts": 1}, "image_size is 48, expected at least 64"),
        (
            {"backbone": "resnet18", "width": 0.2},
            "width is 0.2, .* resnet18 13 channels; expected at least 16 .* use a larger width",
        ),
        ({"backbone": "resnet20"}, "backbone is 'resnet20', expected one of resnet18, .*resnet101"),
    ],
)
def test_config_rejects_impossible_sizes(wrong: dict[str, int], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        FeatureEncoder(PVDAConfig(**wrong))  # type: ignore[arg-type]


@pytest.mark.parametrize("parts", [1, 2, 3, 4])
def test_networks_take_the_smallest_allowed_images(parts: int) -> None:
    least = {1: 64, 2: 64, 3: 96, 4: 128}[parts]
    config = PVDAConfig(**{**vars(TINY), "parts": parts, "image_size": least})
    encoder, classifier, discriminator = (module.eval() for module in on_meta(config))
    maps_BCHW, g_BPD = encoder(torch.empty(2, 3, least, least, dtype=torch.uint8, device="meta"))
    assert discriminator(maps_BCHW).shape == (2, 2)
    assert classifier(g_BPD).shape == (2, parts, 701)


@pytest.mark.parametrize(("parts", "part_dim"), [(4, 512), (1, 8), (3, 7)])
def test_unit_embedding_parts_have_equal_length(parts: int, part_dim: int) -> None:
    g_BPD = 100 * torch.randn(5, parts, part_dim, generator=torch.Generator().manual_seed(0))
    found_BE = unit_embedding(g_BPD)
    assert found_BE.shape == (5, parts * part_dim)
    torch.testing.assert_close(found_BE.norm(dim=1), torch.ones(5))
    lengths_BP = found_BE.view(5, parts, part_dim).norm(dim=2)
    torch.testing.assert_close(lengths_BP, torch.full((5, parts), parts**-0.5))


def test_unit_embedding_by_hand() -> None:
    g_BPD = torch.tensor([[[3.0, 4.0], [0.0, 0.5]]])
    assert unit_embedding(g_BPD)[0].tolist() == pytest.approx(
        [0.6 / 2**0.5, 0.8 / 2**0.5, 0, 1 / 2**0.5]
    )


def test_embed_image_equals_its_mirror_image() -> None:
    torch.manual_seed(0)
    encoder = FeatureEncoder(TINY).eval()
    photos_B3HW = images(3, 3, 64, 64)
    assert torch.equal(embed(encoder, photos_B3HW), embed(encoder, photos_B3HW.flip(3)))
    assert not torch.allclose(
        embed(encoder, photos_B3HW, mirror=False), embed(encoder, photos_B3HW.flip(3), mirror=False)
    )


def test_embed_adds_mirror_before_normalising() -> None:
    torch.manual_seed(0)
    encoder = FeatureEncoder(TINY).eval()
    photos_B3HW = images(2, 3, 64, 64)
    with torch.no_grad():
        together_BPD = encoder(photos_B3HW)[1] + encoder(photos_B3HW.flip(3))[1]
    found_BE = embed(encoder, photos_B3HW)
    torch.testing.assert_close(found_BE, unit_embedding(together_BPD))
    assert found_BE.dtype == torch.float32
    torch.testing.assert_close(found_BE.norm(dim=1), torch.ones(2))
