"""A checkpoint is bytes that give back what went in, run no code, and have a name of their own."""

import hashlib
import io
import json
import pickle
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from model.checkpoint import Checkpoint, build_encoder, dumps, fingerprint, load_encoder, loads
from model.config import PVDAConfig
from model.errors import CheckpointError
from model.inference.embed import embed
from model.pvda import FeatureEncoder

TINY = PVDAConfig(
    backbone="resnet18", width=0.25, image_size=64, parts=2, part_dim=8, discriminator_channels=8
)


@pytest.fixture(scope="module")
def held() -> Checkpoint:
    torch.manual_seed(0)
    return Checkpoint(
        network=TINY,
        recipe={"name": "tiny", "schedule": {"epochs": 3, "decay_epochs": [60, 120]}},
        locations=["0839", "Köln"],
        epoch=2,
        history=[{"epoch": 1, "location_loss": 1.5}, {"epoch": 2, "location_loss": 0.1 + 0.2}],
        state={"modules": {"encoder": FeatureEncoder(TINY).state_dict()}},
    )


def saved(value: Any) -> bytes:
    buffer = io.BytesIO()
    torch.save(value, buffer)
    return buffer.getvalue()


def test_checkpoint_round_trip(held: Checkpoint) -> None:
    found = loads(dumps(held))
    assert (found.network, found.recipe, found.locations) == (
        held.network,
        held.recipe,
        held.locations,
    )
    assert (found.epoch, found.history) == (held.epoch, held.history)
    assert found.encoder_weights.keys() == held.encoder_weights.keys()
    for name, tensor in held.encoder_weights.items():
        assert torch.equal(found.encoder_weights[name], tensor)


def test_checkpoint_file_restores_the_encoder(held: Checkpoint, tmp_path: Path) -> None:
    (tmp_path / "last.pt").write_bytes(dumps(held))
    encoder = load_encoder(str(tmp_path / "last.pt"))
    assert not any(module.training for module in encoder.modules())
    photos_B3HW = torch.randint(
        0, 256, (2, 3, 64, 64), dtype=torch.uint8, generator=torch.Generator().manual_seed(0)
    )
    assert torch.equal(embed(encoder, photos_B3HW), embed(build_encoder(held), photos_B3HW))


NONE_OF_OURS: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda data: b"",
    "text": lambda data: b"<html>404 Not Found</html>",
    "a state dict": lambda data: saved({"conv1.weight": torch.ones(3)}),
    "a tensor": lambda data: saved(torch.ones(3)),
    "a list": lambda data: saved([1, 2]),
    "another format": lambda data: saved(torch.load(io.BytesIO(data)) | {"format": 3}),
    "an unknown setting": lambda data: saved(
        torch.load(io.BytesIO(data)) | {"network": '{"depths": 50}'}
    ),
    "an impossible setting": lambda data: saved(
        torch.load(io.BytesIO(data)) | {"network": '{"backbone": "resnet51"}'}
    ),
    "a pickle that pops an empty stack": lambda data: b"\x80\x020.",
    "a pickle that ends in a number": lambda data: b"\x80\x02X\x05\x00",
}


@pytest.mark.parametrize("spoil", NONE_OF_OURS.values(), ids=NONE_OF_OURS)
def test_loads_rejects_other_files_by_name(
    held: Checkpoint, spoil: Callable[[bytes], bytes]
) -> None:
    with pytest.raises(CheckpointError) as caught:
        loads(spoil(dumps(held)), "photos/last.pt")
    message = str(caught.value)
    assert message.startswith("photos/last.pt is not a checkpoint of format 2")
    assert "expected a last.pt written by jobs/train.py" in message
    assert "\n" not in message


class Trap:
    """What runs when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


def test_checkpoint_with_code_is_rejected(held: Checkpoint, tmp_path: Path) -> None:
    sprung = tmp_path / "sprung"
    plain = torch.load(io.BytesIO(dumps(held)))
    for data in (
        saved(plain | {"epoch": Trap(sprung)}),
        pickle.dumps(plain | {"epoch": Trap(sprung)}),
    ):
        with pytest.raises(CheckpointError):
            loads(data)
        assert not sprung.exists()
    pickle.loads(pickle.dumps(Trap(sprung)))
    assert sprung.exists()  # the trap itself works


def test_fingerprint_survives_a_round_trip(held: Checkpoint) -> None:
    found = fingerprint(held, "bicubic")
    assert len(found) == 64
    assert set(found) <= set("0123456789abcdef")
    assert fingerprint(loads(dumps(held)), "bicubic") == found


def test_fingerprint_changes_with_any_weight(held: Checkpoint) -> None:
    found = {fingerprint(held, "bicubic")}
    weights = held.encoder_weights
    for name in weights:
        other = {n: tensor.clone() for n, tensor in weights.items()}
        other[name].view(-1)[-1] += 1
        found.add(fingerprint(replace(held, state={"modules": {"encoder": other}}), "bicubic"))
    assert len(found) == 1 + len(weights)


def test_fingerprint_changes_with_config_and_encoding(
    held: Checkpoint,
) -> None:
    found = {
        fingerprint(held, "bicubic"),
        fingerprint(held, "bilinear"),
        fingerprint(replace(held, network=replace(TINY, ring_divisor="ring")), "bicubic"),
        fingerprint(replace(held, network=replace(TINY, image_size=80)), "bicubic"),
        fingerprint(replace(held, network=replace(TINY, neck="linear_ones")), "bicubic"),
    }
    assert len(found) == 5


def test_fingerprint_of_an_encoder_from_before_poolings(held: Checkpoint) -> None:
    network = asdict(held.network)
    assert (network.pop("pooling"), network.pop("neck")) == ("rings", "linear")
    digest = hashlib.sha256(json.dumps([network, "bicubic"], sort_keys=True).encode())
    for name, tensor in sorted(held.encoder_weights.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.contiguous().flatten().view(torch.uint8).numpy().tobytes())
    assert fingerprint(held, "bicubic") == digest.hexdigest()


def test_fingerprint_ignores_history_recipe_and_layout(
    held: Checkpoint,
) -> None:
    found = fingerprint(held, "bicubic")
    assert (
        fingerprint(replace(held, epoch=9, history=[], recipe={}, locations=[]), "bicubic") == found
    )
    turned = {
        name: tensor.to(memory_format=torch.channels_last) if tensor.ndim == 4 else tensor
        for name, tensor in held.encoder_weights.items()
    }
    optimised = {"modules": {"encoder": turned, "discriminator": {}}, "optimizers": [1]}
    assert fingerprint(replace(held, state=optimised), "bicubic") == found


def test_checkpoint_keeps_recipe_and_history_as_json(
    held: Checkpoint,
) -> None:
    plain = torch.load(io.BytesIO(dumps(held)), weights_only=True)
    assert json.loads(plain["recipe"])["name"] == "tiny"
    assert json.loads(plain["network"])["backbone"] == "resnet18"
    assert plain["format"] == 2


def test_loads_of_format_1_says_how_to_make_it_anew(held: Checkpoint) -> None:
    old = saved(torch.load(io.BytesIO(dumps(held))) | {"format": 1})
    with pytest.raises(CheckpointError) as caught:
        loads(old, "run/last.pt")
    assert str(caught.value) == (
        "run/last.pt is a checkpoint of format 1, expected format 2, in which settings have other "
        "names; train again with jobs/train.py, or import the weights again with "
        "jobs/import_weights.py"
    )
