"""Foreign weights become a checkpoint that embeds as the original does, or are refused in one
sentence.
"""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
import torch.nn.functional as F
from torch import Tensor

from jobs.embed_gallery import main as embed_gallery
from jobs.encoding.encoder import make_encoder_spec
from jobs.encoding.settings import EncoderSettings
from jobs.stages.import_weights import import_weights
from jobs.stages.settings import EmbedSettings, ImportWeightsSettings
from model.backbones.resnet import ResNet
from model.checkpoint import Checkpoint, build_encoder, load_encoder, loads
from model.errors import CheckpointError
from model.pvda import LocationClassifier
from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.features.settings import EmbeddingSettings
from pipeline.features.table import open_table

State = dict[str, Tensor]
MEAN, DEVIATION = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])


# A twin of the original network, written from its description and from nothing of ours.


def made_up(
    blocks: tuple[int, ...] = (2, 2, 2, 2), grown: int = 1, base: int = 16, seed: int = 0
) -> State:
    """Random weights of a ResNet under torchvision's names; `grown` is 4 with bottlenecks, 1
    without.
    """
    generator, state = torch.Generator().manual_seed(seed), State()

    def conv(name: str, out: int, into: int, side: int) -> None:
        deviation = math.sqrt(2 / (into * side * side))
        state[f"{name}.weight"] = (
            torch.randn(out, into, side, side, generator=generator) * deviation
        )

    conv("conv1", base, 3, 7)
    state |= norm("bn1", base, generator)
    into = base
    for layer, count in enumerate(blocks, start=1):
        width = base * 2 ** (layer - 1)
        for block in range(count):
            at, out = f"layer{layer}.{block}", width * grown
            shapes = (
                [(width, into, 3), (out, width, 3)]
                if grown == 1
                else [(width, into, 1), (width, width, 3), (out, width, 1)]
            )
            for number, (to, of, side) in enumerate(shapes, start=1):
                conv(f"{at}.conv{number}", to, of, side)
                state |= norm(f"{at}.bn{number}", to, generator)
            if block == 0 and (layer > 1 or grown > 1):
                conv(f"{at}.downsample.0", out, into, 1)
                state |= norm(f"{at}.downsample.1", out, generator)
            into = out
    return state


def norm(name: str, size: int, generator: torch.Generator) -> State:
    def noise() -> Tensor:
        return 0.1 * torch.randn(size, generator=generator)

    values = {
        "weight": 1 + noise(),
        "bias": noise(),
        "running_mean": noise(),
        "running_var": 1 + noise().abs(),
    }
    return {f"{name}.{key}": value for key, value in values.items()} | {
        f"{name}.num_batches_tracked": torch.tensor(87)
    }


def three_view_net(
    backbone: State, parts: int = 4, part_dim: int = 24, locations: int = 5
) -> State:
    """As LPN saves a network whose UAV and satellite images share a backbone: it appears under both
    names.
    """
    generator = torch.Generator().manual_seed(7)
    fc = {"fc.weight": torch.ones(1000, 8), "fc.bias": torch.ones(1000)}
    state = {
        f"{view}.model.{key}": value
        for view in ("model_1", "model_3")
        for key, value in (backbone | fc).items()
    }
    state |= {
        f"model_2.model.{key}": value + 1 for key, value in (backbone | fc).items()
    }  # street images
    channels = max(
        value.shape[0] for key, value in backbone.items() if key.startswith("layer4") and value.ndim
    )
    for part in range(parts):
        at = f"classifier{part}"
        state[f"{at}.add_block.0.weight"] = torch.randn(
            part_dim, channels, generator=generator
        ) / math.sqrt(channels)
        state[f"{at}.add_block.0.bias"] = torch.randn(part_dim, generator=generator)
        state |= norm(f"{at}.add_block.1", part_dim, generator)
        state[f"{at}.classifier.0.weight"] = torch.randn(locations, part_dim, generator=generator)
        state[f"{at}.classifier.0.bias"] = torch.randn(locations, generator=generator)
    return state


def normalised(state: State, at: str, x: Tensor) -> Tensor:
    mean, variance, weight, bias = (
        state[f"{at}.{key}"] for key in ("running_mean", "running_var", "weight", "bias")
    )
    return F.batch_norm(x, mean, variance, weight, bias, eps=1e-5)


def twin_maps(state: State, x: Tensor) -> Tensor:
    """ResNet with stride 1 in layer4."""
    x = F.relu(normalised(state, "bn1", F.conv2d(x, state["conv1.weight"], stride=2, padding=3)))
    x = F.max_pool2d(x, 3, 2, 1)
    for layer, stride in ((1, 1), (2, 2), (3, 2), (4, 1)):
        block = 0
        while f"layer{layer}.{block}.conv1.weight" in state:
            at, step, y = f"layer{layer}.{block}", stride if block == 0 else 1, x
            convs = [n for n in (1, 2, 3) if f"{at}.conv{n}.weight" in state]
            for n in convs:
                weight = state[f"{at}.conv{n}.weight"]
                here = (
                    step if n == len(convs) - 1 else 1
                )  # on the first of two, the second of three
                y = normalised(
                    state,
                    f"{at}.bn{n}",
                    F.conv2d(y, weight, stride=here, padding=weight.shape[-1] // 2),
                )
                y = F.relu(y) if n < len(convs) else y
            if f"{at}.downsample.0.weight" in state:
                x = normalised(
                    state,
                    f"{at}.downsample.1",
                    F.conv2d(x, state[f"{at}.downsample.0.weight"], stride=step),
                )
            x, block = F.relu(x + y), block + 1
    return x


def twin_parts(state: State, images: Tensor, parts: int) -> Tensor:
    """What LPN calls a feature: (B, D, P), centre first, each ring its box with the hole filled
    with zeros.
    """
    images = (images.float() / 255 - MEAN[:, None, None]) / DEVIATION[:, None, None]
    backbone = {
        key.removeprefix("model_1.model."): value
        for key, value in state.items()
        if key.startswith("model_1")
    }
    maps = twin_maps(backbone, images)
    centre, step = maps.shape[2] // 2, maps.shape[2] // (2 * parts)
    features = []
    for part in range(1, parts + 1):
        half = part * step if part < parts else centre
        box = maps[:, :, centre - half : centre + half, centre - half : centre + half].clone()
        hole = (part - 1) * step
        box[:, :, half - hole : half + hole, half - hole : half + hole] = 0
        mean = torch.nn.AdaptiveAvgPool2d(1)(box).flatten(1)
        at = f"classifier{part - 1}.add_block"
        features.append(
            normalised(
                state, f"{at}.1", F.linear(mean, state[f"{at}.0.weight"], state[f"{at}.0.bias"])
            )
        )
    return torch.stack(features, 2)


def twin_embedding(state: State, images: Tensor, parts: int) -> Tensor:
    summed = twin_parts(state, images, parts) + twin_parts(state, images.flip(3), parts)
    unit: Tensor = summed / (summed.norm(dim=1, keepdim=True) * math.sqrt(parts))
    # LPN lays the numbers of all parts side by side; ours stand part after part. Inner products are
    # the same.
    return unit.transpose(1, 2).flatten(1)


def photos(size: int, count: int = 2) -> Tensor:
    """Fields of random colours, 8 by 8: images of noise would all look alike."""
    fields = torch.randint(
        0, 256, (count, 3, 8, 8), dtype=torch.uint8, generator=torch.Generator().manual_seed(1)
    )
    return fields.repeat_interleave(size // 8, 2).repeat_interleave(size // 8, 3)


def saved(state: State, path: Path) -> str:
    torch.save(state, path)
    return str(path)


def imported(tmp_path: Path, state: State, image_size: int = 128) -> Checkpoint:
    given = saved(state, tmp_path / "net_119.pth")
    out = import_weights(
        ImportWeightsSettings(lpn=given, out=str(tmp_path / "ours.pt"), image_size=image_size)
    )
    return loads(Path(out).read_bytes())


@pytest.mark.parametrize(
    ("blocks", "grown", "parts", "size"),
    [((2, 2, 2, 2), 1, 4, 128), ((2, 2, 2, 2), 1, 3, 256), ((3, 4, 6, 3), 4, 4, 128)],
    ids=["ResNet-18", "three rings", "ResNet-50"],
)
def test_import_lpn_embeds_as_the_original(
    tmp_path: Path, tiny_shards: str, blocks: tuple[int, ...], grown: int, parts: int, size: int
) -> None:
    state = three_view_net(made_up(blocks, grown), parts)
    imported(tmp_path, state, size)
    path = tmp_path / "ours.pt"
    encode = make_encoder_spec(
        path.read_bytes(), str(path), EmbeddingSettings(shards=tiny_shards, out="none")
    ).factory(2)
    images = photos(size)
    found, expected = encode(images.numpy()), twin_embedding(state, images, parts).numpy()
    assert np.abs(found - expected).max() < 1e-5
    assert np.linalg.norm(expected, axis=1) == pytest.approx(1)
    assert expected[0] @ expected[1] < 0.999  # the test would see a difference


def test_import_lpn_classifies_as_the_original(tmp_path: Path) -> None:
    state = three_view_net(made_up())
    checkpoint = imported(tmp_path, state)
    classifier = LocationClassifier(checkpoint.network, len(checkpoint.locations)).eval()
    classifier.load_state_dict(checkpoint.state["modules"]["classifier"])
    logits_BPL = classifier(build_encoder(checkpoint)(photos(128))[1])
    features = twin_parts(state, photos(128), 4)
    for part in range(4):
        at = f"classifier{part}.classifier.0"
        expected = F.linear(features[:, :, part], state[f"{at}.weight"], state[f"{at}.bias"])
        assert torch.allclose(logits_BPL[:, part], expected, atol=1e-4)


def test_import_lpn_records_its_source(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = imported(tmp_path, three_view_net(made_up()))
    network = checkpoint.network
    assert (network.backbone, network.width, network.image_size) == ("resnet18", 0.25, 128)
    assert (network.parts, network.part_dim, network.ring_divisor) == (4, 24, "box")
    assert (checkpoint.epoch, checkpoint.history) == (0, [])
    assert checkpoint.locations == [f"unnamed-{number}" for number in range(5)]
    assert checkpoint.recipe["name"] == "imported from lpn"
    assert len(checkpoint.recipe["made_of"]["sha256"]) == 64
    said = capsys.readouterr().err
    assert "model_2 is left out" in said
    assert "stride 1 and average pooling" in said
    assert "ours.pt: ResNet-18, 4 rings of 24 numbers, 128 px, 5 locations" in said


def without(state: State, start: str) -> State:
    return {key: value for key, value in state.items() if not key.startswith(start)}


def test_import_lpn_variants_of_backbones_are_equal(
    tmp_path: Path,
) -> None:
    state = three_view_net(made_up())
    expected = imported(tmp_path, state).encoder_weights
    alone = without(without(state, "model_2"), "model_3")
    all_shared = alone | {
        f"model_{n}{key[7:]}": value
        for n in (2, 3)
        for key, value in alone.items()
        if key[:7] == "model_1"
    }
    forms = {
        "alone": alone,
        "shared by two": without(all_shared, "model_3"),
        "shared by three": all_shared,
        "no fc": {key: value for key, value in state.items() if ".fc." not in key},
        "no counts": {
            key: value for key, value in state.items() if "num_batches_tracked" not in key
        },
    }
    for name, form in forms.items():
        (tmp_path / name).mkdir()
        found = imported(tmp_path / name, form).encoder_weights
        for key, tensor in expected.items():
            assert torch.equal(found[key], tensor) or (name == "no counts" and "num_batches" in key)


def changed(key: str, value: Callable[[Tensor], Tensor]) -> Callable[[State], State]:
    return lambda state: state | {key: value(state[key])}


REFUSED: dict[str, tuple[Callable[[State], State], str]] = {
    "UAVs have their own": (
        changed("model_3.model.layer1.0.conv1.weight", lambda t: t + 1),
        r"model_1 and model_3 differ in 1 tensors, layer1\.0\.conv1\.weight first; .*--share",
    ),
    "half of a backbone": (
        lambda state: without(state, "model_3.model.layer4"),
        r"model_1 and model_3 differ in \d+ tensors, layer4",
    ),
    "two views of their own": (
        lambda state: without(state, "model_3"),
        r"model_1 and model_2 differ in \d+ tensors",
    ),
    "a tensor is missing": (
        lambda state: without(state, "classifier2.add_block.1.running_var"),
        r"does not fit resnet18 with 4 rings: classifier2\.add_block\.1\.running_var is missing; expected",
    ),
    "a layer is missing": (
        lambda state: without(without(state, "model_1.model.bn1"), "model_3.model.bn1"),
        r"model_1\.model\.bn1\.weight is missing; .*bn1\.bias",
    ),
    "a classifier is missing": (
        lambda state: without(state, "classifier1"),
        r"classifiers are numbered \[0, 2, 3\]",
    ),
    "torchvision's": (
        lambda state: made_up(),
        r"numbered not at all and its names begin with conv1\.weight, bn1\.weight",
    ),
    "no backbone": (
        lambda state: without(state, "model"),
        r"is of no ResNet that we build: conv1\.weight is missing",
    ),
    "no refinement": (
        lambda state: without(state, "classifier0.add_block"),
        r"classifier0\.add_block\.0\.weight is missing",
    ),
    "nothing": (lambda state: {}, "names begin with nothing"),
}


@pytest.mark.parametrize(("spoil", "sentence"), REFUSED.values(), ids=REFUSED)
def test_import_lpn_rejects_other_networks_by_name(
    tmp_path: Path, spoil: Callable[[State], State], sentence: str
) -> None:
    with pytest.raises(CheckpointError, match=sentence) as caught:
        imported(tmp_path, spoil(three_view_net(made_up())))
    assert "net_119.pth" in str(caught.value)
    assert not (tmp_path / "ours.pt").exists()


@pytest.mark.parametrize("ending", ["pth", "safetensors"])
def test_import_torchvision_reports_untrained_refinement(
    tmp_path: Path, tiny_shards: str, ending: str, capsys: pytest.CaptureFixture[str]
) -> None:
    state, path = made_up() | {"fc.weight": torch.ones(9, 128)}, tmp_path / f"resnet18.{ending}"
    if ending == "pth":
        torch.save(state, path)
    else:
        safetensors.torch.save_file(state, path)
    outs = [
        import_weights(ImportWeightsSettings(torchvision=str(path), out=str(tmp_path / name)))
        for name in ("a.pt", "b.pt")
    ]
    assert "the refinement of the rings is untrained" in capsys.readouterr().err
    checkpoint = loads(Path(outs[0]).read_bytes())
    assert (
        checkpoint.network.backbone,
        checkpoint.network.width,
        checkpoint.network.image_size,
    ) == (
        "resnet18",
        0.25,
        256,
    )
    assert (checkpoint.epoch, checkpoint.history, checkpoint.locations) == (0, [], [])
    encoder = load_encoder(outs[0])
    normal = (photos(256).float() / 255 - MEAN[:, None, None]) / DEVIATION[:, None, None]
    with torch.inference_mode():
        assert torch.allclose(encoder(photos(256))[0], twin_maps(state, normal), atol=1e-4)
    embedding = EmbeddingSettings(shards=tiny_shards, out="none")
    prints = {make_encoder_spec(Path(out).read_bytes(), out, embedding).fingerprint for out in outs}
    assert len(prints) == 1  # the same file gives the same network
    data = Path(outs[0]).read_bytes()
    other = [
        EncoderSettings(resizer="pillow"),
        EncoderSettings(mirror=False),
        EncoderSettings(precision="bfloat16"),
    ]
    networks = [make_encoder_spec(data, "it", embedding, settings) for settings in other]
    assert (
        len(prints | {network.fingerprint for network in networks}) == 4
    )  # tables of other preprocessing do not mix
    assert networks[0].encoding.resizer == "pillow"


def test_import_weights_lists_names_of_another_depth(tmp_path: Path) -> None:
    state = made_up()
    given = saved(state | {"layer1.0.conv9.weight": torch.ones(1)}, tmp_path / "odd.pth")
    with pytest.raises(
        CheckpointError,
        match=r"odd\.pth does not fit this backbone: layer1\.0\.conv9\.weight is unexpected",
    ):
        import_weights(ImportWeightsSettings(torchvision=given, out=str(tmp_path / "o.pt")))


def test_import_weights_feeds_embed_gallery(
    tmp_path: Path, tiny_shards: str, ray_cluster: None
) -> None:
    imported(tmp_path, three_view_net(made_up()))
    table = str(tmp_path / "table")
    embed_gallery(
        EmbedSettings(
            shards=tiny_shards,
            checkpoint=str(tmp_path / "ours.pt"),
            out=table,
            split=Split.QUERY,
            view=View.SATELLITE,
        )
    )
    assert open_table(table).embeddings().shape == (3, 96)


def test_import_weights_finished_is_a_no_op(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    imported(tmp_path, three_view_net(made_up()))
    out = tmp_path / "ours.pt"
    before, written = out.read_bytes(), out.stat().st_mtime_ns
    imported(tmp_path, three_view_net(made_up()))
    assert "nothing to do" in capsys.readouterr().err
    with pytest.raises(
        InputError, match=r"ours\.pt is there and was not made of this file and image size; choose"
    ):
        imported(tmp_path, three_view_net(made_up(seed=1)))
    with pytest.raises(InputError, match=r"ours\.pt is there"):
        imported(tmp_path, three_view_net(made_up()), image_size=256)
    assert (out.read_bytes(), out.stat().st_mtime_ns) == (before, written)
    out.write_bytes(b"somebody's thesis")
    with pytest.raises(InputError, match=r"ours\.pt is there"):
        imported(tmp_path, three_view_net(made_up()))
    assert out.read_bytes() == b"somebody's thesis"


def test_import_weights_wrong_call_names_the_remedy(tmp_path: Path) -> None:
    out = str(tmp_path / "o.pt")
    with pytest.raises(InputError, match="neither of --torchvision and --lpn given"):
        ImportWeightsSettings(out=out)
    with pytest.raises(InputError, match="both of --torchvision and --lpn given"):
        ImportWeightsSettings(out=out, torchvision="a", lpn="b")
    with pytest.raises(
        InputError, match=r"no weights at .*none\.pth; expected .*torchvision\.models\.resnet50"
    ):
        import_weights(ImportWeightsSettings(out=out, torchvision=str(tmp_path / "none.pth")))
    with pytest.raises(InputError, match=r"no weights at .*none\.pth; expected .*LPN"):
        import_weights(ImportWeightsSettings(out=out, lpn=str(tmp_path / "none.pth")))
    with pytest.raises(InputError, match="is a folder"):
        import_weights(ImportWeightsSettings(out=out, lpn=str(tmp_path)))
    with pytest.raises(
        InputError,
        match=r"net_119\.pth: image_size is 64, expected at least 128 pixels for 4 parts",
    ):
        imported(tmp_path, three_view_net(made_up()), image_size=64)
    given = saved(
        {"conv1.weight": torch.ones(1)} | ResNet("resnet18", 0.25).state_dict(), tmp_path / "r.pth"
    )
    with pytest.raises(InputError, match="image_size is 64"):
        import_weights(ImportWeightsSettings(out=out, torchvision=given, image_size=64))
