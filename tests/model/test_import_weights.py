"""Foreign weights become a checkpoint that embeds as the original does, or are refused in one
sentence.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
import torch.nn.functional as F

from jobs.embed_gallery import main as embed_gallery
from jobs.encoding.encoder import make_encoder_spec
from jobs.encoding.settings import EncoderSettings
from jobs.stages.import_weights import import_weights
from jobs.stages.settings import EmbedSettings, ImportWeightsSettings
from model.backbones.resnet import ResNet
from model.checkpoint import build_encoder, load_encoder, loads
from model.errors import CheckpointError
from model.pvda import LocationClassifier
from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.features.settings import EmbeddingSettings
from pipeline.features.table import open_table
from tests.model.lpn_twin import (
    DEVIATION,
    MEAN,
    State,
    changed,
    imported,
    made_up,
    photos,
    saved,
    three_view_net,
    twin_embedding,
    twin_maps,
    twin_parts,
    without,
)

pytestmark = pytest.mark.slow


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
    assert "ours.pt: resnet18, 4 parts of 24 numbers, 128 px, 5 locations" in said


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
        r"does not fit resnet18 with 4 rings: "
        r"classifier2\.add_block\.1\.running_var is missing; expected",
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
        r"is of no backbone that we build: conv1\.weight is missing",
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


def test_import_weights_feeds_embed_gallery(tmp_path: Path, tiny_shards: str) -> None:
    imported(tmp_path, three_view_net(made_up()))
    table = str(tmp_path / "table")
    embed_gallery(
        EmbedSettings(
            shards=tiny_shards,
            checkpoint=str(tmp_path / "ours.pt"),
            out=table,
            split=Split.QUERY,
            view=View.SATELLITE,
            workers=0,
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
    with pytest.raises(InputError, match="none given, expected one of --torchvision, --lpn"):
        ImportWeightsSettings(out=out)
    with pytest.raises(InputError, match="--torchvision and --lpn given, expected one of"):
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
