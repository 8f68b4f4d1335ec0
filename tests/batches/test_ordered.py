"""Shards read in their order, for embedding, by key, and by other programs."""

import json
import tarfile
from pathlib import Path

import numpy as np
import pytest
import webdataset

from pipeline.batches.ordered import decode_samples
from pipeline.images.decode import DecodeError
from pipeline.shards.samples import read_samples

# Reading for embedding and for pictures.


def test_decode_samples_keeps_order_and_returns_errors(shards: str, tmp_path: Path) -> None:
    with (
        tarfile.open(Path(shards) / "train-drone-000002.tar") as old,
        tarfile.open(tmp_path / "x.tar", "w") as new,
    ):
        for number, member in enumerate(old.getmembers()):
            stream = old.extractfile(member)
            if number == 2:  # the second sample's image, cut short
                member.size -= 30
            new.addfile(member, stream)
    found = list(decode_samples(read_samples(str(tmp_path / "x.tar")), 8, threads=2, depth=4))
    assert [sample.key for sample, _ in found] == [
        sample.key for sample in read_samples(f"{shards}/train-drone-000002.tar")
    ]
    kinds = [type(image) for _, image in found]
    assert kinds == [np.ndarray, DecodeError, *[np.ndarray] * 8]
    assert all(image.shape == (8, 8, 3) for _, image in found if not isinstance(image, DecodeError))


def test_tarfile_finds_two_members_a_sample(shards: str) -> None:
    with tarfile.open(Path(shards) / "train-satellite-000000.tar") as tar:
        names = tar.getnames()
        assert {(m.mtime, m.uname, m.mode) for m in tar.getmembers()} == {(0, "root", 0o644)}
    assert len(names) == 16
    assert {name.rsplit(".", 1)[1] for name in names} == {"png", "json"}


@pytest.mark.filterwarnings(
    "ignore:unclosed file:ResourceWarning"
)  # webdataset's own reader leaves it to the collector
def test_plain_webdataset_opens_a_shard_of_images(shards: str) -> None:
    dataset = webdataset.WebDataset(
        str(Path(shards) / "train-satellite-000000.tar"), shardshuffle=False
    )
    found = list(dataset.decode("pil"))
    assert len(found) == 8
    for sample in found:
        assert sample["png"].size == (9, 8)
        assert sample["json"]["key"] == sample["__key__"]
        assert json.dumps(sample["json"])
        assert sample["json"]["view"] == "satellite"
