"""Several views as one query: the images of each group, and their mean."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.retrieval.embedding_set import EmbeddingSet, embedding_set_from_array
from pipeline.retrieval.subsets import mean_by_location, mean_by_views, possible_view_counts


def side(counts: list[int], seed: int = 0) -> EmbeddingSet:
    """So many images of each place, shuffled; image j of place i is keyed i-j."""
    rng = np.random.default_rng(seed)
    rows = [(f"{i}", f"{i}-{j:02d}") for i, count in enumerate(counts) for j in range(count)]
    rows = [rows[at] for at in rng.permutation(len(rows))]
    vectors = rng.standard_normal((len(rows), 8)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    return embedding_set_from_array(
        np.array([key for _, key in rows]), np.array([place for place, _ in rows]), vectors
    )


def whole(of: EmbeddingSet) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    return np.concatenate(list(of.blocks(5)))


def test_possible_view_counts_fit_every_location() -> None:
    assert possible_view_counts(side([54, 55])) == [1, 2, 3, 6, 9, 18, 27, 54]
    assert possible_view_counts(side([54, 7])) == [1, 2, 3, 6]
    assert possible_view_counts(side([1, 1])) == [1]


def test_mean_by_views_groups_every_kth_key() -> None:
    of = side([5, 4])
    grouped = mean_by_views(of, 2)
    assert grouped.keys.tolist() == ["0#0", "0#1", "1#0", "1#1"]
    assert grouped.locations.tolist() == ["0", "0", "1", "1"]
    vectors = dict(zip(of.keys.tolist(), whole(of), strict=True))
    for key, (one, other) in {
        "0#0": ("0-00", "0-02"),
        "0#1": ("0-01", "0-03"),
        "1#1": ("1-01", "1-03"),
    }.items():
        mean = vectors[one] + vectors[other]
        assert whole(grouped)[grouped.keys.tolist().index(key)] == pytest.approx(
            mean / np.linalg.norm(mean), abs=1e-6
        )


def test_mean_by_views_of_all_images_is_mean_by_location() -> None:
    of = side([6, 6, 6])
    assert np.array_equal(whole(mean_by_views(of, 6)), whole(mean_by_location(of)))


@given(st.lists(st.integers(3, 9), min_size=1, max_size=5), st.integers(1, 3), st.integers(0, 99))
def test_mean_by_views_does_not_depend_on_row_order(
    counts: list[int], views: int, seed: int
) -> None:
    of = side(counts, seed)
    order = np.random.default_rng(seed + 1).permutation(len(of.keys))
    turned = embedding_set_from_array(of.keys[order], of.locations[order], whole(of)[order])
    one, other = mean_by_views(of, views), mean_by_views(turned, views)
    assert one.keys.tolist() == other.keys.tolist()
    assert len(one.keys) == sum(count // views for count in counts)
    assert np.array_equal(whole(one), whole(other))
