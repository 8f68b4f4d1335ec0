"""Images that were damaged after packing are replaced within their batch, and named."""

import io
import tarfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.batches.training import TrainingStream
from pipeline.core.errors import InputError
from pipeline.images.augmentation import Augmentation
from pipeline.shards.shard_set import open_shards
from tests.batches.conftest import PLAIN, epoch

# Images that were damaged after packing.


def with_damage(shards: str, out: Path, damaged: Callable[[str], bool]) -> str:
    """The same set; the images whose member's name says so have lost their pixels."""
    for path in filter(Path.is_file, Path(shards).iterdir()):
        if path.suffix != ".tar":
            (out / path.name).write_bytes(path.read_bytes())
            continue
        with tarfile.open(path) as old, tarfile.open(out / path.name, "w") as new:
            for member in old.getmembers():
                stream = old.extractfile(member)
                assert stream is not None
                data = stream.read()
                if member.name.endswith(".png") and damaged(member.name):
                    data = data[:40] + bytes(len(data) - 40)
                new.addfile(member, io.BytesIO(data))
    return str(out)


def odd(name: str) -> bool:
    """Whether an image's number, in its key or its member's name, ends in 1 or 3."""
    return name.split("-")[4][2] in "13"


def test_batch_replaces_a_damaged_image(shards: str, tmp_path: Path) -> None:
    broken = with_damage(shards, tmp_path, odd)
    lively = replace(PLAIN, augmentation=Augmentation(pad=2))
    counted = 0
    for pair, same in zip(
        epoch(shards, 2, reading=lively), epoch(broken, 2, reading=lively), strict=True
    ):
        for batch, found in zip(pair, same, strict=True):
            intact = [position for position, key in enumerate(batch.keys) if not odd(key)]
            taken = [position if position in intact else intact[0] for position in range(4)]
            assert found.keys == tuple(batch.keys[position] for position in taken)
            assert found.damaged == tuple(key for key in batch.keys if odd(key))
            assert found.location_B.tolist() == [batch.location_B[position] for position in taken]
            assert np.array_equal(found.images_B3HW, batch.images_B3HW[taken])
            assert batch.damaged == ()
            counted += len(found.damaged)
    assert counted > 4


def test_epoch_with_damage_resumes_the_same(shards: str, tmp_path: Path) -> None:
    stream = TrainingStream(open_shards(with_damage(shards, tmp_path, odd)), PLAIN)
    for pair, same in zip(list(stream.epoch(1))[3:], stream.epoch(1, 3), strict=True):
        for batch, other in zip(pair, same, strict=True):
            assert (batch.keys, batch.damaged) == (other.keys, other.damaged)
            assert np.array_equal(batch.images_B3HW, other.images_B3HW)


def test_batch_without_an_intact_image_is_refused(shards: str, tmp_path: Path) -> None:
    broken = with_damage(shards, tmp_path, lambda name: "satellite" in name)
    with pytest.raises(
        InputError,
        match=rf"not one of 4 satellite images of a batch from {tmp_path} can be decoded",
    ):
        epoch(broken)


def test_epoch_names_a_shard_with_too_few_samples(shards: str, tmp_path: Path) -> None:
    """One view's batches would end before the other's; zip names neither."""
    for path in filter(Path.is_file, Path(shards).iterdir()):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    with tarfile.open(tmp_path / "train-satellite-000000.tar", "w") as tar:
        member = tarfile.TarInfo("train-satellite-0003-x.txt")
        tar.addfile(member, io.BytesIO(b""))
    with pytest.raises(
        InputError,
        match=rf"{tmp_path}/train-satellite-000000\.tar ends before sample \d, expected the 8 "
        r"samples of the manifest; run jobs/make_shards\.py --verify",
    ):
        epoch(str(tmp_path), reading=replace(PLAIN, batch_size=4))
