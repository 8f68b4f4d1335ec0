"""Training images that stay in memory: the same epochs, read and decoded once."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.batches import kept
from pipeline.batches.kept import KeptSample, KeptShards
from pipeline.batches.settings import StreamConfig
from pipeline.batches.training import TrainingStream
from pipeline.images.augmentation import Augmentation
from pipeline.shards.shard_set import open_shards
from tests.batches.conftest import PLAIN

LIVELY = replace(PLAIN, augmentation=Augmentation(pad=2), shuffle_buffer=8)
CONFIGS = {
    "independent": LIVELY,
    "affine": replace(PLAIN, augmentation=Augmentation(affine=True, scale=0.2, colour=1.0)),
    "another chain": replace(PLAIN, augmentation=Augmentation(chain="sample4geo")),
    "unique_pairs": replace(LIVELY, sampler="unique_pairs"),
    "mirrored pairs": replace(
        PLAIN, sampler="paired", augmentation=Augmentation(pad=2, pair_mirror=True)
    ),
}


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_epochs_are_the_same_whether_images_are_kept(shards: str, config: StreamConfig) -> None:
    keeping = TrainingStream(open_shards(shards), config)
    reading = TrainingStream(open_shards(shards), replace(config, keep_bytes=0))
    for number in (0, 1, 1):
        for pair, same in zip(keeping.epoch(number), reading.epoch(number), strict=True):
            for batch, other in zip(pair, same, strict=True):
                assert batch.keys == other.keys
                assert np.array_equal(batch.images_B3HW, other.images_B3HW)


def test_kept_shards_are_read_and_decoded_once(
    shards: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = Path(shutil.copytree(shards, tmp_path / "copy"))
    stream = TrainingStream(open_shards(str(copy)), LIVELY)
    for number in range(6):  # an epoch draws half of the UAV images
        assert len(list(stream.epoch(number))) == stream.steps
    for tar in copy.glob("*.tar"):
        tar.unlink()
    monkeypatch.setattr(kept, "open_image", None)
    assert len(list(stream.epoch(0))) == stream.steps


def test_as_many_shards_are_kept_as_fit(shards: str) -> None:
    """The first satellite shard fits, the next ones do not, nor the larger ones of the UAV."""
    opened = open_shards(shards)
    first, second = opened.manifest.shards[:2]
    room = first.bytes + first.samples * 3 * PLAIN.image_size**2
    held = KeptShards(opened, replace(PLAIN, keep_bytes=room + second.bytes))
    once, again = list(held.samples(first)), list(held.samples(first))
    assert all(one is other for one, other in zip(once, again, strict=True))
    assert all(isinstance(sample, KeptSample) for sample in once)
    too_many = list(held.samples(second))
    assert len(too_many) == second.samples
    others = [sample for shard in opened.manifest.shards[1:] for sample in held.samples(shard)]
    assert not any(isinstance(sample, KeptSample) for sample in [*too_many, *others])
    assert held.open(once[0]) is held.open(once[0])
    assert held.open(too_many[0]) is not held.open(too_many[0])


def test_images_of_another_chain_are_not_kept(shards: str) -> None:
    """Its first step is random, on the image at its own size."""
    opened = open_shards(shards)
    held = KeptShards(opened, CONFIGS["another chain"])
    sample = next(held.samples(opened.manifest.shards[0]))
    assert isinstance(sample, KeptSample)
    assert held.open(sample).shape == (8, 9, 3)
    assert not sample.opened
