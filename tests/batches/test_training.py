"""An epoch: every image once, the same for the same seed, and resumed at any step."""

from collections import Counter
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from pipeline.batches.training import TrainingStream
from pipeline.core import json_files, storage
from pipeline.core.errors import InputError
from pipeline.core.records import View
from pipeline.images.augmentation import Augmentation
from pipeline.images.decode import decode
from pipeline.shards.manifest import MANIFEST
from pipeline.shards.shard_set import open_shards
from tests.batches.conftest import CLASSES, PLAIN, SATELLITES, epoch, keys

# The training stream.


def test_epoch_has_each_satellite_image_at_most_once(
    shards: str,
) -> None:
    batches = epoch(shards)
    assert TrainingStream(open_shards(shards), PLAIN).steps == len(batches) == SATELLITES // 4
    seen = keys(batches, View.SATELLITE)
    assert len(seen) == len(set(seen)) == 20


def test_epoch_draws_other_uav_images_each_time(shards: str) -> None:
    first, second = (keys(epoch(shards, number), View.DRONE) for number in (0, 1))
    assert len(first) == len(set(first)) == len(second) == 20
    assert set(first) != set(second)


def test_epoch_pairs_are_drawn_independently(shards: str) -> None:
    batches = epoch(shards)
    assert {(drone.view, satellite.view) for drone, satellite in batches} == {
        (View.DRONE, View.SATELLITE)
    }
    assert any(
        drone.location_B.tolist() != satellite.location_B.tolist() for drone, satellite in batches
    )


def test_epoch_drops_another_image_each_time(shards: str) -> None:
    seen = [frozenset(keys(epoch(shards, number), View.SATELLITE)) for number in range(6)]
    assert len(set(seen)) > 2
    assert len(frozenset.union(*seen)) == SATELLITES


@pytest.mark.parametrize("world", [2, 3])
def test_epoch_ranks_share_images_in_equal_steps(shards: str, world: int) -> None:
    ranks = [epoch(shards, 4, rank, world, replace(PLAIN, batch_size=3)) for rank in range(world)]
    assert {len(batches) for batches in ranks} == {SATELLITES // (3 * world)}
    for view in (View.DRONE, View.SATELLITE):
        seen = [key for batches in ranks for key in keys(batches, view)]
        assert len(seen) == len(set(seen)) == 3 * world * (SATELLITES // (3 * world))


def test_epoch_is_the_same_with_any_threads(shards: str) -> None:
    lively = replace(PLAIN, augmentation=Augmentation(pad=2))
    once, again = (epoch(shards, 3, reading=replace(lively, threads=threads)) for threads in (1, 3))
    for pair, same in zip(once, again, strict=True):
        for batch, other in zip(pair, same, strict=True):
            assert batch.keys == other.keys
            assert np.array_equal(batch.images_B3HW, other.images_B3HW)


def test_epoch_order_depends_on_epoch_and_seed(shards: str) -> None:
    orders = {
        tuple(keys(epoch(shards, number, reading=replace(PLAIN, seed=seed)), View.SATELLITE))
        for number in (0, 1, 2)
        for seed in (0, 1)
    }
    assert len(orders) == 6


def test_epoch_augments_by_epoch_and_rank(shards: str) -> None:
    turning = replace(PLAIN, augmentation=Augmentation(pad=0, mirror=False), batch_size=3)
    corners = []
    for number, rank in ((0, 0), (1, 0), (0, 1)):
        batches = epoch(shards, number, rank, 2, turning)
        corners.append([(satellite.images_B3HW.sum(1) == 0).tobytes() for _, satellite in batches])
    assert corners[0] != corners[1]
    assert corners[0] != corners[2]


def test_epoch_does_not_depend_on_earlier_ones(shards: str) -> None:
    stream = TrainingStream(open_shards(shards), PLAIN)
    for number in (0, 1):
        last = list(stream.epoch(number))
    assert [pair[1].keys for pair in last] == [pair[1].keys for pair in epoch(shards, 1)]


@pytest.mark.parametrize("skip", [0, 1, 4, 5])
def test_epoch_resumes_at_any_step(shards: str, skip: int, monkeypatch: pytest.MonkeyPatch) -> None:
    lively = replace(PLAIN, augmentation=Augmentation(pad=2), shuffle_buffer=7)
    complete = epoch(shards, 2, reading=lively)
    opened = count()
    monkeypatch.setattr(
        "pipeline.batches.ordered.decode", lambda data: (next(opened), decode(data))[1]
    )
    rest = list(TrainingStream(open_shards(shards), lively).epoch(2, skip))
    assert len(rest) == len(complete) - skip
    assert next(opened) == 2 * 4 * len(rest)  # what is skipped is not decoded
    for pair, same in zip(complete[skip:], rest, strict=True):
        for batch, other in zip(pair, same, strict=True):
            assert batch.keys == other.keys
            assert np.array_equal(batch.images_B3HW, other.images_B3HW)


def test_batch_labels_and_images_match_their_keys(shards: str) -> None:
    for pair in epoch(shards):
        for batch in pair:
            assert batch.images_B3HW.shape == (4, 3, 8, 8)
            assert batch.images_B3HW.dtype == np.uint8
            assert batch.location_B.dtype == np.int64
            for key, label, image_3HW in zip(
                batch.keys, batch.location_B, batch.images_B3HW, strict=True
            ):
                number = int(key.split("-")[4])
                assert label == number % len(CLASSES)
                colour = (number, 2 * number, list(View).index(batch.view))
                assert (image_3HW == np.array(colour)[:, None, None]).all()


def test_batch_images_are_channels_last(shards: str) -> None:
    images_B3HW = epoch(shards)[0][0].images_B3HW
    assert images_B3HW.transpose(0, 2, 3, 1).flags.c_contiguous


@pytest.mark.parametrize(("batch_size", "world"), [(22, 1), (11, 2)])
def test_stream_refuses_a_set_below_one_step(shards: str, batch_size: int, world: int) -> None:
    with pytest.raises(
        InputError, match=r"21 satellite and 40 UAV .* one batch of 22 .*smaller batch"
    ):
        TrainingStream(open_shards(shards), replace(PLAIN, batch_size=batch_size), 0, world)


def test_epoch_repeats_uav_images_where_they_are_few(shards: str, tmp_path: Path) -> None:
    content = json_files.read_checksummed(storage.join(shards, MANIFEST))
    content["shards"] = [
        shard
        for shard in content["shards"]
        if shard["view"] == "satellite" or shard["samples"] == 10
    ]
    for tar in Path(shards).glob("*.tar"):
        (tmp_path / tar.name).symlink_to(tar)
    json_files.write_checksummed(str(tmp_path / MANIFEST), content)
    seen = Counter(keys(epoch(str(tmp_path)), View.DRONE))
    assert set(seen.values()) == {2}
    assert len(seen) == 10
