"""Bootstrap intervals: their coverage, their dependence on locations, and their reproducibility."""

import numpy as np
import pytest

from pipeline.retrieval.bootstrap import confidence_intervals, paired_difference, resampled_means


def test_confidence_intervals_of_a_constant_are_the_mean() -> None:
    found = confidence_intervals(np.full((6, 1), 0.25), np.array(list("aabbcc")))
    assert found.tolist() == [[0.25], [0.25]]


def test_confidence_intervals_of_single_query_locations() -> None:
    values = (np.arange(400) % 4 == 0).astype(float)[:, None]
    low, high = confidence_intervals(values, np.arange(400).astype(str))[:, 0]
    assert (high - low) / 2 == pytest.approx(1.96 * np.sqrt(0.25 * 0.75 / 400), rel=0.1)


def test_confidence_intervals_count_a_location_once() -> None:
    """Ten equal images of each place carry no more information than one."""
    one = (np.arange(60) % 3 == 0).astype(float)[:, None]
    places = np.arange(60).astype(str)
    assert confidence_intervals(np.repeat(one, 10, axis=0), np.repeat(places, 10)) == pytest.approx(
        confidence_intervals(one, places)
    )


def test_resampled_means_weigh_locations_by_their_queries() -> None:
    """Two places, of three hits and of one miss: in any draw the mean is 0, 1 or 3/4."""
    means = resampled_means(
        np.array([[1.0], [1], [1], [0]]), np.array(["a", "a", "a", "b"]), samples=200
    )
    assert set(np.unique(means).tolist()) == {0.0, 0.75, 1.0}


def test_resampled_means_do_not_depend_on_the_block_size(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    values, places = (
        np.random.default_rng(0).random((50, 2)),
        np.repeat(np.arange(10), 5).astype(str),
    )
    first = resampled_means(values, places, samples=100)
    monkeypatch.setattr("pipeline.retrieval.bootstrap.WEIGHTS_PER_BLOCK", 70)
    assert np.array_equal(resampled_means(values, places, samples=100), first)


def test_confidence_intervals_without_queries_are_nan() -> None:
    assert np.isnan(confidence_intervals(np.empty((0, 3)), np.array([], np.str_))).all()


def test_paired_difference_p_follows_how_many_locations_agree() -> None:
    places = np.arange(40).astype(str)
    always = paired_difference(np.ones(40), np.zeros(40), places)
    assert (always.mean, always.low, always.high) == (1, 1, 1)
    assert always.p == pytest.approx(2 / 2001)
    half = paired_difference(
        (np.arange(40) % 2).astype(float), ((np.arange(40) + 1) % 2).astype(float), places
    )
    assert half.mean == 0
    assert half.p > 0.5
