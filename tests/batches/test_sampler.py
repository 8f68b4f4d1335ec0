"""The planner of an epoch: spans by random numbers alone; and the samples that it reads."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.batches.kept import KeptShards
from pipeline.batches.sampler import Span, plan_pass, read_spans
from pipeline.batches.training import TrainingStream
from pipeline.core.records import Split, View
from pipeline.shards.manifest import Shard
from pipeline.shards.samples import read_samples
from pipeline.shards.shard_set import open_shards
from tests.batches.conftest import CLASSES, PLAIN

# The planner.

SIZES = st.lists(st.integers(0, 9), min_size=1, max_size=6)


def shard_list(sizes: list[int]) -> list[Shard]:
    return [
        Shard(
            name=f"s{number}",
            split=Split.TRAIN,
            view=View.DRONE,
            samples=samples,
            bytes=0,
            sha256="",
        )
        for number, samples in enumerate(sizes)
    ]


def planned(
    sizes: list[int], wanted: int, rank: int, world: int, seed: int
) -> list[tuple[str, int]]:
    """Shard and position of each sample that a rank reads."""
    spans = plan_pass(shard_list(sizes), wanted, rank, world, np.random.default_rng(seed))
    return [
        (span.shard.name, position) for span in spans for position in range(span.start, span.stop)
    ]


@settings(max_examples=200)
@given(sizes=SIZES, wanted=st.integers(0, 30), world=st.integers(1, 5), seed=st.integers(0, 99))
def test_plan_pass_repeats_no_sample_before_all_came(
    sizes: list[int], wanted: int, world: int, seed: int
) -> None:
    ranks = [planned(sizes, wanted, rank, world, seed) for rank in range(world)]
    total = sum(sizes)
    assert [len(rank) for rank in ranks] == [wanted if total else 0] * world
    seen = Counter(sample for rank in ranks for sample in rank)
    assert all(0 <= position < sizes[int(name[1:])] for name, position in seen)
    if total:
        rounds, rest = divmod(
            world * wanted, total
        )  # the ring gone round again where it is too short
        assert set(seen.values()) <= {rounds, rounds + 1}
        assert sum(times == rounds + 1 for times in seen.values()) == rest
        assert len(seen) == (total if rounds else rest)


@settings(max_examples=50)
@given(sizes=SIZES, wanted=st.integers(0, 30), world=st.integers(1, 5), seed=st.integers(0, 99))
def test_plan_pass_depends_on_the_seed_alone(
    sizes: list[int], wanted: int, world: int, seed: int
) -> None:
    assert planned(sizes, wanted, world - 1, world, seed) == planned(
        sizes, wanted, world - 1, world, seed
    )


def test_plan_pass_drops_each_sample_sometimes() -> None:
    left_out = {("s0", n) for n in range(5)} | {("s1", n) for n in range(4)}
    for seed in range(60):
        left_out &= set(planned([5, 4], 8, 0, 1, seed))
    assert not left_out


def test_plan_pass_of_empty_shards_is_empty() -> None:
    assert planned([], 5, 0, 1, 0) == planned([0, 0], 5, 0, 1, 0) == []


# Reading and its order.


@pytest.mark.parametrize("buffer", [1, 7, 100])
def test_shuffle_keeps_every_sample_and_repeats(shards: str, buffer: int) -> None:
    stream = TrainingStream(open_shards(shards), replace(PLAIN, shuffle_buffer=buffer))
    once, again = (
        [sample.key for _, sample in stream.sample_pipeline(View.SATELLITE, 3)] for _ in range(2)
    )
    spans = stream.plan(View.SATELLITE, 3)
    planned_keys = [
        sample.key for sample in read_spans(KeptShards(stream.shards, PLAIN), frozenset(), spans)
    ]
    assert once == again
    assert sorted(once) == sorted(planned_keys)
    assert (once == planned_keys) == (buffer == 1)


def test_read_spans_of_a_packed_shard(shards: str) -> None:
    samples = list(read_samples(f"{shards}/train-satellite-000002.tar"))
    assert [sample.key for sample in samples] == [sample.metadata["key"] for sample in samples]
    assert [sample.metadata["location"] for sample in samples] == [
        CLASSES[number % 4] for number in range(16, 21)
    ]
    assert all(sample.data.startswith(b"\x89PNG") for sample in samples)
    opened = open_shards(shards)
    shard = next(one for one in opened.manifest.shards if one.name == "train-satellite-000002")
    part = list(
        read_spans(KeptShards(opened, PLAIN), frozenset(), [Span(shard=shard, start=1, stop=3)])
    )
    assert [sample.key for sample in part] == [sample.key for sample in samples[1:3]]
