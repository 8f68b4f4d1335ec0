"""Pairs of distinct locations: grouped in order, resumed at any step, damage replaced as pairs."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import count, islice
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.batches.pairs import group_distinct
from pipeline.batches.training import TrainingStream
from pipeline.core.errors import InputError
from pipeline.images.augmentation import Augmentation
from pipeline.shards.shard_set import open_shards
from tests.batches.conftest import PLAIN, SATELLITES, epoch
from tests.batches.test_damaged_images import with_damage

PAIRS = replace(PLAIN, sampler="unique_pairs", batch_size=3)


@given(st.lists(st.sampled_from("abcde"), max_size=60), st.integers(1, 5))
def test_group_distinct_keeps_order_and_loses_only_the_rest(names: list[str], size: int) -> None:
    items = list(enumerate(names))
    groups = list(group_distinct(items, lambda item: item[1], size))
    taken = [item for group in groups for item in group]
    assert len(set(taken)) == len(taken)
    for group in groups:
        assert len({location for _, location in group}) == len(group) == size
    # Images of one location come in their order, so none is passed over by a later one.
    for location in set(names):
        own = [item for item in taken if item[1] == location]
        assert own == [item for item in items if item[1] == location][: len(own)]
    # No group could be made of what is left.
    assert len({location for _, location in set(items) - set(taken)}) < size


def test_group_distinct_reads_no_further_than_it_must() -> None:
    read = count()

    def source() -> Iterator[str]:
        for name in "aabbcc":
            next(read)
            yield name

    assert list(islice(group_distinct(source(), str, 2), 1)) == [["a", "b"]]
    assert next(read) == 3


def test_epoch_rows_are_pairs_of_distinct_locations(shards: str) -> None:
    for number in (0, 1):
        batches = epoch(shards, number, reading=PAIRS)
        assert len(batches) == SATELLITES // 3
        for drone, satellite in batches:
            assert drone.location_B.tolist() == satellite.location_B.tolist()
            assert len(set(drone.location_B.tolist())) == 3
            for key, other in zip(drone.keys, satellite.keys, strict=True):
                assert "drone" in key
                assert "satellite" in other
    orders = {tuple(epoch(shards, number, reading=PAIRS)[0][0].keys) for number in range(4)}
    assert len(orders) > 1


@pytest.mark.parametrize("skip", [0, 1, 6, 7])
def test_paired_epoch_resumes_at_any_step(shards: str, skip: int) -> None:
    lively = replace(PAIRS, augmentation=Augmentation(pad=2), shuffle_buffer=7)
    complete = epoch(shards, 2, reading=lively)
    rest = list(TrainingStream(open_shards(shards), lively).epoch(2, skip))
    assert len(rest) == len(complete) - skip
    for pair, same in zip(complete[skip:], rest, strict=True):
        for batch, other in zip(pair, same, strict=True):
            assert batch.keys == other.keys
            assert np.array_equal(batch.images_B3HW, other.images_B3HW)


def test_paired_epoch_is_the_same_with_any_threads(shards: str) -> None:
    lively = replace(PAIRS, augmentation=Augmentation(pad=2))
    once, again = (epoch(shards, 1, reading=replace(lively, threads=n)) for n in (1, 3))
    for pair, same in zip(once, again, strict=True):
        assert [batch.keys for batch in pair] == [batch.keys for batch in same]
        assert all(np.array_equal(a.images_B3HW, b.images_B3HW)
                   for a, b in zip(pair, same, strict=True))  # fmt: skip


def test_paired_epoch_ranks_take_equal_steps(shards: str) -> None:
    ranks = [epoch(shards, 4, rank, 2, PAIRS) for rank in range(2)]
    assert [len(batches) for batches in ranks] == [SATELLITES // 6] * 2
    assert ranks[0][0][0].keys != ranks[1][0][0].keys


def test_damaged_image_takes_its_pair_along(shards: str, tmp_path: Path) -> None:
    broken = with_damage(
        shards, tmp_path, lambda name: "satellite" in name and name.split("-")[4][2] in "13"
    )
    counted = 0
    for pair, same in zip(
        epoch(shards, 2, reading=PAIRS), epoch(broken, 2, reading=PAIRS), strict=True
    ):
        drone, satellite = same
        assert drone.location_B.tolist() == satellite.location_B.tolist()
        intact = [row for row in range(3) if pair[1].keys[row] not in satellite.damaged]
        taken = [row if row in intact else intact[0] for row in range(3)]
        assert drone.keys == tuple(pair[0].keys[row] for row in taken)
        assert satellite.keys == tuple(pair[1].keys[row] for row in taken)
        assert drone.damaged == ()
        counted += len(satellite.damaged)
    assert counted > 0


def test_pairs_need_a_location_for_each_row(shards: str) -> None:
    with pytest.raises(InputError, match=r"has 4 training locations, expected at least 5.*smaller"):
        epoch(shards, reading=replace(PAIRS, batch_size=5))


def test_pairs_need_a_satellite_image(shards: str) -> None:
    stream = TrainingStream(open_shards(shards), PAIRS)
    with pytest.raises(InputError, match=r"'0042' of .* has UAV images and no satellite image"):
        stream._satellites.one_of("0042", np.random.default_rng(0))
