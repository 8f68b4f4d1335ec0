"""Locations held out of training: chosen by name, never streamed, without a class."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.batches.holdout import exclude_locations, holdout_locations
from pipeline.batches.settings import StreamConfig
from pipeline.batches.training import TrainingStream
from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.shards.manifest import read_manifest
from pipeline.shards.shard_set import open_shards

NAMES = [f"{number:04d}" for number in range(1000)]


def test_holdout_is_about_the_share_asked_for() -> None:
    assert holdout_locations(NAMES, 0.0) == frozenset()
    assert 70 <= len(holdout_locations(NAMES, 0.1)) <= 130


@pytest.mark.slow
@given(st.sets(st.sampled_from(NAMES), min_size=200))
def test_holdout_depends_on_the_name_alone(some: set[str]) -> None:
    assert holdout_locations(sorted(some), 0.2) == holdout_locations(NAMES, 0.2) & some


@pytest.mark.parametrize("share", [0.0001, 0.9999])
def test_holdout_refuses_too_small_a_rest(share: float) -> None:
    with pytest.raises(InputError, match="expected at least two held out and two to train on"):
        holdout_locations(NAMES[:20], share)


def test_stream_without_holdout_locations(
    tiny_shards: str,
) -> None:
    share = next(
        share for tenth in range(1, 10) if len(chosen(tiny_shards, share := tenth / 10)) == 2
    )
    stream = TrainingStream(
        open_shards(tiny_shards), StreamConfig(batch_size=2, image_size=32, hold_out=share)
    )
    assert len(stream.held_out) == 2
    assert set(stream.classes) == set(stream.shards.manifest.classes) - stream.held_out
    assert sorted(stream.classes.values()) == [0, 1, 2, 3]
    assert stream.steps == 2
    names = {number: name for name, number in stream.classes.items()}
    for epoch in range(3):
        batches = [batch for pair in stream.epoch(epoch) for batch in pair]
        keys = [key for batch in batches if batch.view == View.SATELLITE for key in batch.keys]
        assert len(set(keys)) == 4
        for batch in batches:
            for key, label in zip(batch.keys, batch.location_B, strict=True):
                assert f"-{names[int(label)].lower()}-" in key


def chosen(shards: str, share: float) -> frozenset[str]:
    try:
        return holdout_locations(read_manifest(shards).classes, share)
    except InputError:
        return frozenset()


def test_exclude_locations_counts_the_others(tiny_shards: str) -> None:
    manifest = read_manifest(tiny_shards)
    drones = manifest.of(Split.TRAIN, View.DRONE)
    assert exclude_locations(open_shards(tiny_shards), drones, frozenset()) == drones
    counted = exclude_locations(open_shards(tiny_shards), drones, frozenset(manifest.classes[:2]))
    assert sum(shard.samples for shard in counted) == 3 * (len(manifest.classes) - 2)
    assert [replace(shard, samples=0) for shard in counted] == [
        replace(shard, samples=0) for shard in drones
    ]
