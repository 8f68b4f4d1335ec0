"""Exact ranking: equal to brute force, and independent of block sizes and workers."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.core.arrays import Floats
from pipeline.core.errors import InputError
from pipeline.retrieval import exact_scores, metrics
from pipeline.retrieval.embedding_set import (
    EmbeddingSet,
    embedding_set_from_array,
    filter_locations,
)
from pipeline.retrieval.exact_scores import error_bound, round_to_grid
from pipeline.retrieval.ranking import BlockSizes, Ranking, rank, rank_distributed
from pipeline.retrieval.subsets import mean_by_location


def unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True), np.float32)


def side(vectors: Floats, locations: list[str]) -> EmbeddingSet:
    return embedding_set_from_array(
        np.array([f"k{i}" for i in range(len(locations))]), np.array(locations), unit(vectors)
    )


@st.composite
def sides(draw: st.DrawFn) -> tuple[EmbeddingSet, EmbeddingSet]:
    """Queries and a gallery with few locations and, often, so few distinct vectors that most scores
    tie.
    """
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    distinct, dimension = draw(st.sampled_from([1, 2, 5, 1000])), draw(st.integers(1, 9))
    pool = unit(rng.standard_normal((distinct, dimension)).astype(np.float32))

    def one(rows: int) -> EmbeddingSet:
        return side(
            pool[rng.integers(0, distinct, rows)], [f"L{i}" for i in rng.integers(0, 4, rows)]
        )

    return one(draw(st.integers(1, 12))), one(draw(st.integers(1, 60)))


cuts = st.builds(
    BlockSizes,
    queries_in_memory=st.integers(1, 13),
    query_rows=st.integers(1, 13),
    gallery_rows=st.integers(1, 61),
)


def brute(
    queries: EmbeddingSet, gallery: EmbeddingSet, top: int
) -> list[tuple[list[int], list[int], list[float]]]:
    """For each query: the ranks of its true matches, its top rows and their scores, by sorting the
    full gallery.
    """
    query_QD, gallery_GD = (
        round_to_grid(next(s.blocks(10**6))).astype(np.float64) for s in (queries, gallery)
    )
    found = []
    for vector, location in zip(query_QD, queries.locations, strict=True):
        scores = [float(np.float32(math.fsum(vector * other))) for other in gallery_GD]
        right = [bool(other == location) for other in gallery.locations]
        order = sorted(range(len(scores)), key=lambda row: (-scores[row], right[row], row))
        ranks = [rank_ for rank_, row in enumerate(order, 1) if right[row]]
        found.append((ranks, order[:top], [scores[row] for row in order[:top]]))
    return found


SPARSE_SHARES = (-1, math.inf)  # never and always the path that gathers the entries that matter


@pytest.mark.slow
@given(sides(), cuts, st.integers(1, 12), st.sampled_from(SPARSE_SHARES))
@settings(max_examples=150)
def test_rank_equals_brute_force_for_any_block_sizes(
    pair: tuple[EmbeddingSet, EmbeddingSet], cut: BlockSizes, top: int, few: float
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exact_scores, "MAX_SPARSE_SHARE", few)
        found = rank(*pair, top, cut)
    for q, (ranks, rows, scores) in enumerate(brute(*pair, top)):
        assert found.matches_Q[q] == len(ranks)
        assert found.first_rank_Q[q] == (ranks[0] if ranks else 0)
        expected = metrics.average_precisions(
            np.array(ranks, np.int64), np.zeros(len(ranks), np.int64), 1
        )[0]
        assert found.ap_Q[q] == pytest.approx(expected, abs=1e-12)
        assert found.top_rows_QK[q].tolist() == rows
        assert found.top_scores_QK[q].tolist() == scores


def same(one: Ranking, other: Ranking) -> bool:
    return all(
        np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True)
        for name in Ranking.__dataclass_fields__
    )


def test_rank_is_bit_identical_for_any_block_sizes() -> None:
    rng = np.random.default_rng(0)
    pool = rng.standard_normal((40, 257)).astype(np.float32)
    queries = side(pool[rng.integers(0, 40, 40)], [f"{i % 30}" for i in range(40)])
    gallery = side(pool[rng.integers(0, 40, 120)], [f"{i % 35}" for i in range(120)])
    reference = rank(queries, gallery)
    for rows in (3, 7, 64, 119):
        assert same(
            rank(
                queries,
                gallery,
                blocks=BlockSizes(queries_in_memory=25, query_rows=rows, gallery_rows=rows),
            ),
            reference,
        )


def test_rank_is_bit_identical_for_any_number_of_workers(ray_cluster: None) -> None:
    rng = np.random.default_rng(3)
    queries = side(
        rng.standard_normal((23, 16)).astype(np.float32), [f"{i % 7}" for i in range(23)]
    )
    gallery = side(
        rng.standard_normal((90, 16)).astype(np.float32), [f"{i % 9}" for i in range(90)]
    )
    reference, scored = rank(queries, gallery, 5), [0]

    def advance(scores: int) -> None:
        scored[0] += scores

    assert same(rank_distributed(queries, gallery, 5, 0, lambda scores: None), reference)
    assert same(rank_distributed(queries, gallery, 5, 2, advance), reference)
    assert same(
        rank_distributed(
            queries, gallery, 5, 2, advance, BlockSizes(queries_in_memory=4, query_rows=3)
        ),
        reference,
    )
    assert scored == [2 * 23 * 90]


@pytest.mark.parametrize("spread", [0.0, 1e-7, 1e-5, 1e-3, 0.1])
@pytest.mark.parametrize("each", [1, 3, 30])
@pytest.mark.parametrize("few", SPARSE_SHARES)
def test_rank_resolves_near_ties_exactly(
    spread: float, each: int, few: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Vectors that differ by less than float32 products resolve: every score is uncertain."""
    monkeypatch.setattr(exact_scores, "MAX_SPARSE_SHARE", few)
    rng = np.random.default_rng(4)
    centre = rng.standard_normal(300)
    queries = side(
        (centre + spread * rng.standard_normal((9, 300))).astype(np.float32),
        [f"{i % 4}" for i in range(9)],
    )
    names = [f"{i % 4}" if i < 4 * each else f"x{i}" for i in range(4 * each + 60)]
    gallery = side(
        (centre + spread * rng.standard_normal((len(names), 300))).astype(np.float32), names
    )
    found = rank(queries, gallery, 10, BlockSizes(query_rows=4, gallery_rows=50))
    for q, (ranks, rows, scores) in enumerate(brute(queries, gallery, 10)):
        assert found.first_rank_Q[q] == ranks[0]
        expected = metrics.average_precisions(np.array(ranks), np.zeros(len(ranks), np.int64), 1)[0]
        assert found.ap_Q[q] == pytest.approx(expected, abs=1e-12)
        assert found.top_rows_QK[q].tolist() == rows
        assert found.top_scores_QK[q].tolist() == scores


@given(st.integers(0, 2**32 - 1), st.sampled_from([2, 64, 2048]))
@settings(max_examples=25)
def test_error_bound_holds_for_float32_products(seed: int, dimension: int) -> None:
    rng = np.random.default_rng(seed)
    one, other = (
        round_to_grid(unit(np.abs(rng.standard_normal((8, dimension))).astype(np.float32)))
        for _ in range(2)
    )
    exact = (one.astype(np.float64) @ other.astype(np.float64).T).astype(np.float32)
    assert np.abs(exact.astype(np.float64) - one @ other.T).max() <= error_bound(dimension)


def test_rank_counts_many_matches_per_query() -> None:
    rng = np.random.default_rng(1)
    queries = side(rng.standard_normal((5, 8)).astype(np.float32), ["a", "a", "b", "c", "none"])
    gallery = side(
        rng.standard_normal((200, 8)).astype(np.float32),
        [["a", "b", "x"][i % 3] for i in range(197)] + ["c"] * 3,
    )
    found = rank(queries, gallery)
    for q, (ranks, rows, _) in enumerate(brute(queries, gallery, 10)):
        assert found.first_rank_Q[q] == (ranks[0] if ranks else 0)
        assert found.top_rows_QK[q].tolist() == rows
    assert found.first_row_Q[4] == -1
    assert math.isnan(found.first_score_Q[4])


def test_rank_of_equal_vectors_is_last() -> None:
    queries, gallery = (
        side(np.ones((4, 8), np.float32), list("abcd")),
        side(np.ones((6, 8), np.float32), list("abcdxy")),
    )
    found = rank(queries, gallery)
    assert found.first_rank_Q.tolist() == [6, 6, 6, 6]
    assert found.top_rows_QK[1].tolist() == [0, 2, 3, 4, 5, 1]


def test_rank_scores_equal_the_plain_product() -> None:
    vectors = unit(np.random.default_rng(2).standard_normal((20, 2048)).astype(np.float32))
    names = np.array([str(i) for i in range(20)])
    found = rank(
        embedding_set_from_array(names, names, vectors[:5]),
        embedding_set_from_array(names, names, vectors),
        top=20,
    )
    plain = vectors[:5].astype(np.float64) @ vectors.astype(np.float64).T
    assert (
        np.abs(np.take_along_axis(plain, found.top_rows_QK, 1) - found.top_scores_QK).max() < 1e-7
    )
    assert found.first_rank_Q.tolist() == [1] * 5


@pytest.mark.parametrize("spoilt", [0.0, 3.0, math.nan])
def test_rank_refuses_vectors_not_of_unit_length(spoilt: float) -> None:
    vectors = np.eye(3, dtype=np.float32)
    vectors[1] *= spoilt
    names = np.array(list("abc"))
    with pytest.raises(InputError, match=r"row 1 .* expected unit length; normalise"):
        rank(
            embedding_set_from_array(names, names, np.eye(3, dtype=np.float32)),
            embedding_set_from_array(names, names, vectors),
        )


def test_mean_by_location_is_at_unit_length() -> None:
    merged = mean_by_location(
        side(np.array([[1, 0], [0, 1], [0, 1], [1, 0]], np.float32), ["b", "a", "b", "b"])
    )
    assert merged.keys.tolist() == merged.locations.tolist() == ["a", "b"]
    assert np.concatenate(list(merged.blocks(1))) == pytest.approx(
        np.array([[0, 1], [2 / 5**0.5, 1 / 5**0.5]])
    )


def test_filter_locations_keeps_rows_in_order() -> None:
    reduced = filter_locations(
        side(np.eye(5, dtype=np.float32), list("axbya")), np.array(["a", "b", "c"])
    )
    assert reduced.keys.tolist() == ["k0", "k2", "k4"]
    assert np.concatenate(list(reduced.blocks(2))).argmax(axis=1).tolist() == [0, 2, 4]
