"""The sampler `paired`, against what it promises: each location exactly so many times an epoch."""

from collections import Counter
from dataclasses import replace
from itertools import count, groupby
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.batches.pairs import plan_locations, take_planned
from pipeline.batches.settings import StreamConfig
from pipeline.batches.training import TrainingStream
from pipeline.core.errors import InputError
from pipeline.core.records import View
from pipeline.images.augmentation import Augmentation
from pipeline.images.decode import decode
from pipeline.shards.shard_set import open_shards
from tests.batches.conftest import CLASSES, DRONES, PLAIN, epoch, keys
from tests.batches.test_damaged_images import with_damage

pytestmark = pytest.mark.slow

PAIRED = replace(PLAIN, sampler="paired", batch_size=2)


def labels(
    shards: str, number: int, reading: StreamConfig, rank: int = 0, world: int = 1
) -> list[int]:
    return [int(label) for drone, _ in epoch(shards, number, rank, world, reading)
            for label in drone.location_B]  # fmt: skip


@given(
    st.integers(1, 9), st.integers(1, 4), st.integers(1, 3), st.integers(1, 4), st.integers(0, 9)
)
def test_plan_gives_ranks_disjoint_locations(
    locations: int, repeats: int, world: int, batch: int, seed: int
) -> None:
    names = [f"{number}" for number in range(locations)]
    rows = locations // world * repeats // batch * batch
    plans = [
        plan_locations(names, repeats, rows, rank, world, np.random.default_rng(seed))
        for rank in range(world)
    ]
    taken = [name for plan in plans for name in plan]
    assert len(taken) == len(set(taken))
    for plan in plans:
        assert sum(plan.values()) == rows
        assert sorted(plan.values(), reverse=True)[:-1] == [repeats] * (len(plan) - 1)
        assert all(1 <= times <= repeats for times in plan.values())


@given(
    st.lists(st.sampled_from("abcd"), max_size=40),
    st.dictionaries(st.sampled_from("abcd"), st.integers(1, 3)),
)
def test_take_planned_is_the_brute_force_one(names: list[str], planned: dict[str, int]) -> None:
    items, read = list(enumerate(names)), count()
    source = (item for item in items if next(read) >= 0)
    first = {
        name: [item for item in items if item[1] == name][:times] for name, times in planned.items()
    }
    if any(len(first[name]) < times for name, times in planned.items()):
        with pytest.raises(InputError, match="have too few UAV images"):
            list(take_planned(source, lambda item: item[1], planned, "set"))
        return
    expected = [item for group in sorted(first.values(), key=lambda group: group[-1])
                for item in group]  # fmt: skip
    assert list(take_planned(source, lambda item: item[1], planned, "set")) == expected
    # Nothing is read after the last planned item.
    assert next(read) == (max(item[0] for item in expected) + 1 if expected else 0)


@pytest.mark.parametrize("repeats", [1, 2, 3])
def test_epoch_has_each_location_so_many_times(shards: str, repeats: int) -> None:
    reading = replace(PAIRED, pair_repeats=repeats)
    for number in range(3):
        batches = epoch(shards, number, reading=reading)
        assert len(batches) == len(CLASSES) * repeats // 2
        for drone, satellite in batches:
            assert drone.location_B.tolist() == satellite.location_B.tolist()
            for row, label in enumerate(drone.location_B):
                name = f"-{CLASSES[int(label)].lower()}-"
                assert name in drone.keys[row]
                assert name in satellite.keys[row]
        rows = [int(label) for drone, _ in batches for label in drone.location_B]
        assert Counter(rows) == dict.fromkeys(range(4), repeats)
        # A location's rows are neighbours.
        assert [len(list(group)) for _, group in groupby(rows)] == [repeats] * 4


def test_epoch_drops_the_last_partial_batch(shards: str) -> None:
    reading = replace(PAIRED, batch_size=3)
    epochs = [labels(shards, number, reading) for number in range(12)]
    assert all(len(rows) == len(set(rows)) == 3 for rows in epochs)
    assert len({frozenset(rows) for rows in epochs}) == 4  # another location is dropped each time
    tripled = Counter(labels(shards, 0, replace(PAIRED, batch_size=5, pair_repeats=3)))
    assert sorted(tripled.values()) == [1, 3, 3, 3]


def test_epochs_differ_in_order_and_images(shards: str) -> None:
    epochs = [epoch(shards, number, reading=PAIRED) for number in range(8)]
    assert len({tuple(keys(batches, View.DRONE)) for batches in epochs}) == 8
    assert len({tuple(keys(batches, View.SATELLITE)) for batches in epochs}) > 4
    drawn = {key for batches in epochs for key in keys(batches, View.DRONE)}
    assert len(drawn) > DRONES // 3
    again = epoch(shards, 3, reading=PAIRED)
    assert keys(again, View.DRONE) == keys(epochs[3], View.DRONE)


@pytest.mark.parametrize("repeats", [1, 2])
def test_ranks_take_disjoint_locations(shards: str, repeats: int) -> None:
    reading = replace(PAIRED, pair_repeats=repeats)
    for number in range(3):
        first, second = (Counter(labels(shards, number, reading, rank, 2)) for rank in (0, 1))
        assert first + second == dict.fromkeys(range(4), repeats)
        assert not first & second
    # Of four locations three ranks take one each; the fourth is dropped.
    single = replace(PAIRED, batch_size=1)
    shares = [labels(shards, 0, single, rank, 3) for rank in range(3)]
    assert [len(share) for share in shares] == [1, 1, 1]
    assert len({share[0] for share in shares}) == 3


@pytest.mark.parametrize("skip", [0, 1, 5, 6])
def test_paired_k_resumes_at_any_step(
    shards: str, skip: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    lively = replace(PAIRED, pair_repeats=3, shuffle_buffer=7,
                     augmentation=Augmentation(pad=2, pair_mirror=True))  # fmt: skip
    complete, opened = epoch(shards, 2, reading=lively), count()
    monkeypatch.setattr(
        "pipeline.batches.ordered.decode", lambda data: (next(opened), decode(data))[1]
    )
    rest = list(TrainingStream(open_shards(shards), lively).epoch(2, skip))
    assert len(rest) == len(complete) - skip == 6 - skip
    assert next(opened) == 2 * 2 * len(rest)  # neither skipped nor unwanted images are decoded
    for pair, same in zip(complete[skip:], rest, strict=True):
        for batch, other in zip(pair, same, strict=True):
            assert batch.keys == other.keys
            assert np.array_equal(batch.images_B3HW, other.images_B3HW)


def test_more_repeats_than_images_take_them_again(shards: str) -> None:
    batches = epoch(shards, reading=replace(PAIRED, pair_repeats=12))  # ten UAV images each
    drawn = Counter(keys(batches, View.DRONE))
    assert len(drawn) <= DRONES
    assert sum(drawn.values()) == 4 * 12


def test_paired_k_needs_locations_for_a_batch(shards: str) -> None:
    found = r"has 4 training locations, expected at least 5 for one batch .*; train with a smaller"
    with pytest.raises(InputError, match=found):
        TrainingStream(open_shards(shards), replace(PAIRED, batch_size=5))
    with pytest.raises(InputError, match="expected at least 6"):
        TrainingStream(open_shards(shards), replace(PAIRED, batch_size=3), 0, 2)


def test_paired_k_needs_uav_images_of_each_location(
    shards: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "pipeline.batches.training.location_of",
        lambda sample: sample.metadata["location"].replace("Aa", "0003"),
    )
    for repeats in (1, 3):
        with pytest.raises(InputError, match=r"1 of 4 training .*'Aa' and on.* or pack again"):
            epoch(shards, reading=replace(PAIRED, pair_repeats=repeats))


def test_paired_k_replaces_damage_as_pairs(shards: str, tmp_path: Path) -> None:
    broken = with_damage(shards, tmp_path, lambda name: "satellite" in name and "0003" in name)
    reading = replace(PAIRED, batch_size=4)
    [(drone, satellite)] = epoch(broken, reading=reading)
    assert drone.location_B.tolist() == satellite.location_B.tolist()
    assert len(satellite.damaged) == 1
    assert len(set(drone.location_B.tolist())) == 3


@pytest.mark.parametrize("sampler", ["paired", "unique_pairs"])
def test_pairs_are_mirrored_together(
    shards: str, sampler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On images whose left half is black: both of a pair are mirrored, or neither."""
    half_HW3 = np.zeros((8, 8, 3), np.uint8)
    half_HW3[:, 4:] = 255
    monkeypatch.setattr("pipeline.batches.ordered.decode", lambda data: half_HW3)
    still = replace(PAIRED.augmentation, pair_mirror=True)
    reading = replace(PAIRED, sampler=sampler, augmentation=still)  # type: ignore[arg-type]
    seen = []
    for number in range(12):
        for drone, satellite in epoch(shards, number, reading=reading):
            assert np.array_equal(drone.images_B3HW, satellite.images_B3HW)
            seen += (drone.images_B3HW[:, 0, 0, 0] == 255).tolist()
    assert 0.25 < np.mean(seen) < 0.75


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"pair_repeats": 3}, "--pair-repeats 3 with --sampler independent"),
        ({"pair_repeats": 0, "sampler": "paired"}, "--pair-repeats is 0, expected 1 or more"),
        ({"augmentation": Augmentation(pair_mirror=True)}, "--pair-mirror with --sampler indep"),
    ],
)
def test_stream_rejects_settings_without_effect(settings: dict[str, object], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        StreamConfig(**settings)  # type: ignore[arg-type]
