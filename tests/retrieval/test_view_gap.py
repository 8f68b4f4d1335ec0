"""The gap between two views: statistics by hand, projection by invariants, and the sampled rows."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.arrays import Floats
from pipeline.retrieval import view_gap
from pipeline.retrieval.embedding_set import EmbeddingSet, embedding_set_from_array
from pipeline.retrieval.subsets import RowSample, evenly_spaced, take_rows, vectors_by_key


def chosen(locations: str, vectors_ND: Floats) -> RowSample:
    places = np.array(locations.split(), np.str_)
    keys = np.array([f"{place}-{i}" for i, place in enumerate(places)], np.str_)
    return RowSample(keys_N=keys, locations_N=places, vectors_ND=vectors_ND)


def side(rows: int, dimension: int = 3) -> EmbeddingSet:
    names = np.arange(rows).astype(np.str_)
    return embedding_set_from_array(
        names, names, np.arange(rows * dimension, dtype=np.float32).reshape(rows, dimension)
    )


@given(total=st.integers(0, 300), most=st.integers(2, 40))
def test_evenly_spaced_is_distinct_and_reaches_both_ends(total: int, most: int) -> None:
    found = evenly_spaced(total, most)
    assert len(found) == min(total, most)
    assert (np.diff(found) > 0).all()
    assert not total or (found[0], found[-1]) == (0, total - 1)


def test_take_rows_keeps_the_order_across_blocks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("pipeline.retrieval.subsets.BLOCK_ROWS", 4)
    found = take_rows(side(11), np.array([9, 0, 3, 9]))
    assert found.keys_N.tolist() == ["9", "0", "3", "9"]
    assert found.vectors_ND[:, 0].tolist() == [27, 0, 9, 27]
    assert {
        key: row[0] for key, row in vectors_by_key(side(11), ["10", "2", "absent"]).items()
    } == {"10": 30, "2": 6}
    assert vectors_by_key(side(11), ["absent"]) == {}


def test_choose_common_rows_is_even_over_common_places() -> None:
    queries = np.repeat(["a", "b", "c"], 50).astype(np.str_)
    gallery = np.array(["distractor", "c", "b", "a", "only here"], np.str_)
    rows = view_gap.choose_common_rows(queries, gallery, most=12)
    assert sorted(queries[rows[0]].tolist()) == ["a"] * 4 + ["b"] * 4 + ["c"] * 4
    assert gallery[rows[1]].tolist() == ["a", "b", "c"]
    assert queries[view_gap.choose_common_rows(queries, gallery, most=2)[0]].tolist() == ["a", "c"]
    assert [len(each) for each in view_gap.choose_common_rows(queries, gallery[:1])] == [0, 0]


def test_mean_distance_is_in_units_of_a_views_spread() -> None:
    # Two views, each two points at distance 1 from their mean; the means lie 3 apart.
    one = np.array([[0, 1], [0, -1]], np.float32)
    assert view_gap.mean_distance(one, one + np.array([3, 0], np.float32)) == pytest.approx(3)
    # Spreads of 1 and 3: root mean square sqrt(5).
    assert view_gap.mean_distance(one, 3 * one + np.array([3, 0], np.float32)) == pytest.approx(
        3 / np.sqrt(5)
    )


def test_project_pca_weighs_both_views_equally() -> None:
    query = np.array([[2, 0, 0], [-2, 0, 0]], np.float32)
    gallery = np.array(
        [[0, 1, 0], [0, -1, 0]] * 5, np.float32
    )  # five times as many rows have the same weight
    found = view_gap.project_pca(query, gallery)
    assert found.shares == pytest.approx((0.8, 0.2))  # variances 4 and 1 of a half each
    assert np.abs(found.points_S2[:3]) == pytest.approx(
        np.array([[2, 0], [2, 0], [0, 1]]), abs=1e-12
    )
    assert view_gap.project_pca(query, gallery).points_S2.tolist() == found.points_S2.tolist()


def test_describe_gap_of_equal_vectors_is_zero() -> None:
    same = np.tile(np.array([1, 0], np.float32), (4, 1))
    found = view_gap.describe_gap(chosen("a a b b", same), chosen("a b c d", same))
    assert (found["shares"], found["distance"]) == ([0, 0], 0)
    assert {(point["x"], point["y"]) for point in found["points"]} == {(0, 0)}


def test_describe_gap_separates_true_and_other_pairs() -> None:
    eye = np.eye(4, dtype=np.float32)
    found = view_gap.describe_gap(chosen("a b b", eye[[0, 1, 1]]), chosen("b c a", eye[[1, 2, 3]]))
    assert found["true"] == {
        "pairs": 3,
        "mean": pytest.approx(2 / 3, abs=1e-5),
        "low": pytest.approx(0.1),
        "high": 1,
    }
    assert (found["other"]["pairs"], found["other"]["mean"]) == (6, 0)
    assert [found["points"][i]["location"] for pair in found["joined"] for i in pair] == [
        "a",
        "a",
        "b",
        "b",
    ]
    assert [point["side"] for point in found["points"]] == ["query"] * 3 + ["gallery"] * 3


def test_describe_gap_refuses_a_single_place() -> None:
    with pytest.raises(ValueError, match="show one place"):
        view_gap.describe_gap(
            chosen("a a", np.eye(2, dtype=np.float32)), chosen("a", np.eye(2, dtype=np.float32)[:1])
        )
