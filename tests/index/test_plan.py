"""Invariants of the planner: within the budget, never less recall for more memory."""

from dataclasses import replace

import faiss
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.errors import InputError
from pipeline.index.planning.families import FAMILIES
from pipeline.index.planning.plan import (
    EXACT_ROWS,
    GallerySpec,
    IndexPlan,
    plan_factory,
    plan_index,
)

galleries = st.builds(
    GallerySpec,
    rows=st.integers(1, 10**9),
    dimension=st.sampled_from([16, 100, 512, 768, 2048]),
    budget=st.floats(1e8, 1e12),
    target_recall=st.floats(0.5, 1),
    workers=st.integers(0, 16),
    effective_dimension=st.sampled_from([None, 16, 96, 256]),
    rows_readable=st.booleans(),
)


def planned(gallery: GallerySpec) -> IndexPlan | None:
    try:
        return plan_index(gallery)
    except InputError:
        return None


@given(galleries)
def test_plan_is_never_over_the_budget(gallery: GallerySpec) -> None:
    plan = planned(gallery)
    if plan is not None:
        assert plan.search_bytes <= gallery.budget
        assert plan.build_bytes <= gallery.budget
        assert 4 * plan.training_rows * gallery.dimension <= gallery.budget
        assert 1 <= plan.unit_rows <= max(plan.part_rows, gallery.rows)


@given(galleries, st.floats(1, 100))
def test_plan_more_memory_never_lowers_recall(gallery: GallerySpec, more: float) -> None:
    plan = planned(gallery)
    if plan is not None:
        richer = plan_index(replace(gallery, budget=gallery.budget * more))
        reached = [min(gallery.target_recall, each.expected_recall) for each in (plan, richer)]
        assert reached[1] >= reached[0]


@given(galleries)
def test_plan_over_budget_is_rejected_with_bytes_needed(gallery: GallerySpec) -> None:
    starved = replace(gallery, budget=1e6)
    with pytest.raises(InputError, match=r"GB at least, by .*raise --memory-budget"):
        plan_index(starved)


@given(galleries)
def test_plan_is_built_by_faiss(gallery: GallerySpec) -> None:
    plan = planned(replace(gallery, rows=min(gallery.rows, 10**7)))
    if plan is not None:
        index = faiss.index_factory(gallery.dimension, plan.factory, faiss.METRIC_INNER_PRODUCT)
        assert index.is_trained == (plan.training_rows == 0)
        lists = faiss.try_extract_index_ivf(index)
        assert lists is None or lists.nlist <= max(1, plan.training_rows)


@given(galleries)
def test_plan_ignores_vectors_without_row_access(gallery: GallerySpec) -> None:
    plan = planned(replace(gallery, rows_readable=False))
    assert plan is None or plan.refine == "none"


def test_plan_few_rows_are_searched_exactly() -> None:
    plan = plan_index(GallerySpec(rows=EXACT_ROWS, dimension=2048, budget=4e9, target_recall=0.95))
    assert (plan.factory, plan.training_rows, plan.expected_recall) == ("Flat", 0, 1.0)
    assert plan.reason == "exact search: 100,000 rows are few enough to compare each"
    assert (
        plan_index(
            GallerySpec(rows=EXACT_ROWS + 1, dimension=2048, budget=4e9, target_recall=0.95)
        ).factory
        != "Flat"
    )


def test_plan_memory_matches_the_index() -> None:
    """Lists of 8-bit codes of 1,000,000 x 2048 with their ids: 2.056 GB, beside the process and the
    centroids.
    """
    plan = plan_index(
        GallerySpec(rows=10**6, dimension=2048, budget=8e9, target_recall=0.95, rows_readable=False)
    )
    assert plan.factory == "IVF2048,SQ8"
    assert plan.search_bytes == pytest.approx(2.056e9 + 2048 * 2048 * 4 + 300e6, rel=0.01)
    assert plan.reason == "lists of 8-bit codes: 2,056 bytes a row"


def test_plan_tight_budget_uses_disk_or_smaller_codes() -> None:
    gallery = GallerySpec(rows=10**7, dimension=2048, budget=4e9, target_recall=0.95)
    assert (plan_index(gallery).factory, plan_index(gallery).refine) == (
        "IVF2048,PQ256x4fs",
        "table",
    )
    tight = plan_index(replace(gallery, budget=2e9))
    elsewhere = plan_index(replace(gallery, budget=2e9, rows_readable=False))
    assert (tight.factory, elsewhere.factory) == ("IVF1024,RaBitQ", "IVF1024,SQ8")
    for plan in (tight, elsewhere):
        assert plan.on_disk
        assert plan.part_rows < gallery.rows, "what does not fit the memory cannot be merged in it"


def test_plan_uses_few_strong_directions() -> None:
    gallery = GallerySpec(rows=10**6, dimension=2048, budget=4e9, target_recall=0.95)
    assert plan_index(replace(gallery, effective_dimension=256)).factory.startswith("PCA256,IVF")
    assert not plan_index(replace(gallery, effective_dimension=1500)).factory.startswith("PCA")


def test_plan_unreachable_recall_takes_the_best_family() -> None:
    best = max(family.ceiling for family in FAMILIES)
    gallery = GallerySpec(rows=10**6, dimension=2048, budget=64e9, target_recall=1.0)
    assert plan_index(gallery).expected_recall == best
    assert plan_index(replace(gallery, target_recall=0.99)).factory == "IVF2048,SQfp16"


def test_plan_takes_the_users_factory() -> None:
    plan = plan_factory(
        GallerySpec(rows=10**6, dimension=2048, budget=64e9, target_recall=1.0),
        "IVF16384,PQ64",
        "table",
    )
    assert (plan.factory, plan.refine, plan.training_rows) == ("IVF16384,PQ64", "table", 819_200)
