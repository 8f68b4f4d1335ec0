"""Invariants of choosing among tried plans: limits are kept, a looser one never costs recall."""

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.errors import InputError
from pipeline.index.planning.choice import (
    PlanTrial,
    TrialPoint,
    choose,
    pareto_front,
    reaches,
    rejection,
)
from pipeline.index.planning.plan import GallerySpec, IndexPlan

points = st.builds(
    TrialPoint,
    nprobe_or_ef=st.integers(1, 1024),
    rerank_factor=st.sampled_from([1, 10, 80]),
    recall=st.floats(0.3, 1),
    sample_recall=st.floats(0.3, 1),
    queries_per_second=st.floats(1, 1e5),
    p99_ms=st.floats(0.01, 100),
)


def a_plan(number: int, memory: float) -> IndexPlan:
    return IndexPlan(
        factory=f"IVF{number},SQ8", refine="none", on_disk=False, training_rows=1, unit_rows=1,
        part_rows=1, search_bytes=memory, build_bytes=0, expected_recall=0.9, reason="",
    )  # fmt: skip


plan_trials = st.builds(
    PlanTrial,
    plan=st.builds(a_plan, st.integers(1, 10**6), st.floats(1e6, 8e9)),
    points=st.lists(points, min_size=1, max_size=4).map(tuple),
    bytes_per_row=st.floats(8, 8192),
    build_seconds=st.floats(1, 1e4),
    sample_rows=st.just(8192),
)
trial_lists = st.lists(plan_trials, min_size=1, max_size=5)
galleries = st.builds(
    GallerySpec,
    rows=st.just(10**6),
    dimension=st.just(512),
    budget=st.floats(1e6, 8e9),
    target_recall=st.floats(0.5, 1),
    p99_ms=st.none() | st.floats(0.01, 100),
    build_seconds=st.none() | st.floats(1, 1e4),
)
LOOSER = {"p99_ms": 2.0, "build_seconds": 3.0, "budget": 1.5}


def useful_recall(trials: list[PlanTrial], gallery: GallerySpec) -> float:
    """Recall of the choice, up to the target; -1 where no plan keeps the limits."""
    try:
        return min(gallery.target_recall, choose(trials, gallery)[1].recall)
    except InputError:
        return -1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", LOOSER)
@given(trials=trial_lists, gallery=galleries)
def test_looser_limit_never_lowers_recall(
    name: str, trials: list[PlanTrial], gallery: GallerySpec
) -> None:
    limit = getattr(gallery, name)
    if limit is not None:
        for looser in {limit * LOOSER[name], None if name != "budget" else 1e12}:
            changed = replace(gallery, **{name: looser})
            assert useful_recall(trials, changed) >= useful_recall(trials, gallery)


@given(trials=trial_lists, gallery=galleries)
def test_choice_keeps_every_limit(trials: list[PlanTrial], gallery: GallerySpec) -> None:
    try:
        trial, point = choose(trials, gallery)
    except InputError:
        return
    assert trial.plan.bytes <= gallery.budget
    assert gallery.p99_ms is None or point.p99_ms <= gallery.p99_ms
    assert gallery.build_seconds is None or trial.build_seconds <= gallery.build_seconds
    assert (point.recall >= gallery.target_recall) == any(reaches(one, gallery) for one in trials)
    for other in trials:
        assert rejection(other, gallery, (trial, point))


@given(trials=trial_lists)
def test_pareto_front_has_the_best_of_each(trials: list[PlanTrial]) -> None:
    front = pareto_front(trials)
    everything = [(trial, point) for trial in trials for point in trial.points]
    assert max(p.recall for _, p in front) == max(p.recall for _, p in everything)
    assert min(p.p99_ms for _, p in front) == min(p.p99_ms for _, p in everything)
    assert min(t.bytes_per_row for t, _ in front) == min(t.bytes_per_row for t, _ in everything)


def test_rejection_says_which_limit_a_plan_misses() -> None:
    point = TrialPoint(
        nprobe_or_ef=4, rerank_factor=1, recall=0.96, sample_recall=0.97,
        queries_per_second=100, p99_ms=4,
    )  # fmt: skip
    slow = PlanTrial(
        plan=a_plan(64, 1e6), points=(point,), bytes_per_row=40, build_seconds=90, sample_rows=8192
    )
    fast = replace(slow, points=(replace(point, queries_per_second=300),))
    gallery = GallerySpec(rows=10**6, dimension=512, budget=1e9, target_recall=0.95)

    def why(**changes: Any) -> str:
        return rejection(slow, replace(gallery, **changes), (fast, fast.points[0]))

    assert why() == "slower: 100 queries/s at recall@10 0.960 against 300"
    assert why(p99_ms=2) == "p99 4.00 ms at recall@10 0.960, 2 given"
    assert why(build_seconds=60) == "would be built in 90 s, 60 given"
    assert why(target_recall=0.98) == "recall@10 0.960 at most (0.970 on 8,192 rows), below 0.98"
    with pytest.raises(InputError, match=r"--p99-ms is 1, .*IVF64,SQ8, is expected to take 4.00"):
        choose([slow], replace(gallery, p99_ms=1))
    with pytest.raises(InputError, match=r"--build-minutes allows 60 s, .*expected to take 90 s"):
        choose([slow], replace(gallery, build_seconds=60))
