"""A checkpoint with a damaged bit is not loaded: torch itself compares none of its checksums."""

import zipfile
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
import torch

from model.checkpoint import CHECKSUM_BYTES, Checkpoint, check_integrity, dumps, loads
from model.config import PVDAConfig
from model.errors import CheckpointError
from model.pvda import FeatureEncoder
from model.weights.load import read_state_dict
from tests.damaging import count_detected, damaged_versions, error_message, raising_if_missing

pytestmark = pytest.mark.slow


@pytest.fixture
def held() -> Checkpoint:
    torch.manual_seed(0)
    network = PVDAConfig(backbone="resnet18", width=0.25, image_size=64, parts=2, part_dim=16)
    weights = FeatureEncoder(network).state_dict()
    return Checkpoint(
        network=network,
        recipe={"name": "tiny"},
        locations=["a", "b"],
        epoch=1,
        history=[{"epoch": 1}],
        state={"modules": {"encoder": weights}},
    )


def unsealed(data: bytes) -> bytes:
    """As it was written before there were seals."""
    return data[: -CHECKSUM_BYTES - 2] + bytes(2)


def plain(value: Any) -> Any:
    """A checkpoint as what can be compared."""
    if isinstance(value, Checkpoint):
        return plain(vars(value))
    if isinstance(value, dict):
        return {name: plain(one) for name, one in value.items()}
    return value.numpy().tobytes() if isinstance(value, torch.Tensor) else value


def test_checkpoint_damaged_is_rejected(held: Checkpoint, tmp_path: Path) -> None:
    path = tmp_path / "last.pt"
    path.write_bytes(dumps(held))
    look = raising_if_missing(
        path, lambda: plain(loads(path.read_bytes(), str(path))), CheckpointError
    )
    assert count_detected(path, look, 120, CheckpointError) == 121


def test_checkpoint_damaged_zip_directory_is_found(held: Checkpoint) -> None:
    """No checksum of the zip covers them, and torch takes other weights for them without a word."""
    data = dumps(held)
    end = data[zipfile.ZipFile(BytesIO(data)).start_dir :]
    for number, damaged in enumerate(damaged_versions(end, 300)):
        if damaged is not None and damaged != end:
            said = error_message(
                partial(check_integrity, data[: -len(end)] + damaged, "x"), CheckpointError
            )
            assert said is not None, number


def test_checkpoint_without_checksum_checks_its_weights(held: Checkpoint, tmp_path: Path) -> None:
    data = unsealed(dumps(held))
    assert plain(loads(data)) == plain(held)
    path = tmp_path / "last.pt"
    path.write_bytes(data)
    begin = len(data) // 3
    for place in range(begin, begin + 40):
        with pytest.raises(CheckpointError, match=r"x is damaged .*copy it again"):
            loads(data[:place] + bytes([data[place] ^ 16]) + data[place + 1 :], "x")


def test_checkpoint_with_checksum_is_read_by_torch(held: Checkpoint, tmp_path: Path) -> None:
    path = tmp_path / "last.pt"
    path.write_bytes(dumps(held))
    for mapped in (False, True):
        assert torch.load(path, weights_only=True, mmap=mapped)["epoch"] == 1
    assert zipfile.ZipFile(path).testzip() is None


def test_weights_damaged_are_rejected(held: Checkpoint, tmp_path: Path) -> None:
    path = tmp_path / "resnet.pth"
    torch.save(held.encoder_weights, path)
    look = raising_if_missing(path, lambda: plain(read_state_dict(str(path))), CheckpointError)
    good, expected, refused = path.read_bytes(), look(), 0
    for place in range(len(good) // 2, len(good) // 2 + 40):
        path.write_bytes(good[:place] + bytes([good[place] ^ 1]) + good[place + 1 :])
        refused += error_message(look, CheckpointError) is not None
    assert refused == 40
    path.write_bytes(good)
    assert look() == expected
