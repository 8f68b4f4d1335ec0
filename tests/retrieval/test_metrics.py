"""Measures against numbers worked by hand, and against the bound that holds for one match per
query."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.arrays import Ints
from pipeline.retrieval import metrics


def ragged(ranks: list[list[int]]) -> tuple[Ints, Ints, int]:
    """Each query's match ranks, as the flat arrays that the measures take."""
    owner_P = np.repeat(np.arange(len(ranks)), [len(r) for r in ranks])
    return np.array([rank for r in ranks for rank in r], np.int64), owner_P, len(ranks)


@pytest.mark.parametrize(
    ("ranks", "ap"),
    [
        ([1], 1.0),
        ([2], 1 / 4),  # one match at rank k > 1 gives 1/(2k), not 1/k
        ([3], 1 / 6),
        ([10], 1 / 20),
        ([1, 2], 1.0),
        ([1, 3], (1 + (1 / 2 + 2 / 3) / 2) / 2),
        ([2, 4], ((0 + 1 / 2) / 2 + (1 / 3 + 2 / 4) / 2) / 2),
        ([2, 3, 7], ((0 + 1 / 2) / 2 + (1 / 2 + 2 / 3) / 2 + (2 / 6 + 3 / 7) / 2) / 3),
        ([], 0.0),
    ],
)
def test_average_precision_is_the_area_by_trapezoids(ranks: list[int], ap: float) -> None:
    assert metrics.average_precisions(*ragged([ranks]))[0] == pytest.approx(ap, abs=1e-15)


def test_average_precision_is_computed_per_query() -> None:
    found = metrics.average_precisions(*ragged([[2], [], [1, 3], [1]]))
    assert found.tolist() == pytest.approx([0.25, 0.0, (1 + (1 / 2 + 2 / 3) / 2) / 2, 1.0])


def test_first_match_rank_is_the_best_or_zero() -> None:
    assert metrics.first_match_ranks(*ragged([[4, 9], [], [1], []])).tolist() == [4, 0, 1, 0]


def test_recall_counts_queries_without_a_match() -> None:
    first_Q = np.array([1, 2, 5, 0])
    assert [metrics.recall_at(k, first_Q) for k in (1, 2, 4, 5, 100)] == [
        0.25,
        0.5,
        0.5,
        0.75,
        0.75,
    ]


@pytest.mark.parametrize(
    ("gallery", "k"),
    [(951, 11), (51_355, 515), (701, 8), (50, 1), (150, 3), (250, 3), (1, 1), (100, 2)],
)
def test_one_percent_k_is_the_fields_rank(gallery: int, k: int) -> None:
    assert metrics.one_percent_k(gallery) == k


def test_summarise_has_every_measure() -> None:
    first_Q, ap_Q = np.array([1, 6, 11, 12]), np.array([1.0, 0.5, 0.25, 0.25])
    found = metrics.summarise(first_Q, ap_Q, gallery=951)
    assert found == metrics.RetrievalMetrics(r1=0.25, r5=0.25, r10=0.5, r1p=0.75, ap=0.5)


def test_summarise_without_queries_is_zero() -> None:
    none = np.array([], np.int64)
    assert metrics.summarise(none, none.astype(float), 5) == metrics.RetrievalMetrics(
        r1=0, r5=0, r10=0, r1p=0, ap=0
    )


def test_chance_recall_is_the_matching_share_of_the_gallery() -> None:
    assert metrics.chance_recall(np.array([1, 3, 0]), gallery=8) == pytest.approx(
        (1 / 8 + 3 / 8) / 3
    )
    assert metrics.chance_recall(np.array([], np.int64), gallery=8) == 0


@given(st.lists(st.integers(1, 400), min_size=1, max_size=30))
def test_average_precision_of_one_match_obeys_its_bound(ranks: list[int]) -> None:
    flat = ragged([[rank] for rank in ranks])
    r1 = metrics.recall_at(1, metrics.first_match_ranks(*flat))
    assert metrics.average_precisions(*flat).mean() <= r1 + 0.25 * (1 - r1) + 1e-12


@given(
    st.lists(
        st.lists(st.integers(1, 60), unique=True, max_size=8).map(sorted), min_size=1, max_size=10
    )
)
def test_average_precision_equals_the_official_loop(ranks: list[list[int]]) -> None:
    def official(positions: list[int]) -> float:
        total = 0.0
        for i, position in enumerate(positions):
            r = position - 1
            total += ((i / r if r else 1.0) + (i + 1) / (r + 1)) / 2 / len(positions)
        return total

    assert metrics.average_precisions(*ragged(ranks)).tolist() == pytest.approx(
        [official(r) for r in ranks]
    )
