"""Thresholds to answer at, by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.confidence.cross_validation import UNDECIDED, wrong_share_threshold


def test_wrong_share_threshold_by_hand() -> None:
    """The first wrong one is one of four given: too many at a share of 0.2, not at 0.25."""
    p, yes = np.array([0.9, 0.8, 0.7, 0.6, 0.2]), np.array([1.0, 1, 1, 0, 0])
    between = 1 / (1 + ((0.3 / 0.7) * (0.4 / 0.6)) ** 0.5)  # midway in log-odds of 0.7 and 0.6
    assert wrong_share_threshold(p, yes, np.ones(5), 0.2) == pytest.approx(between)
    below = wrong_share_threshold(p, yes, np.ones(5), 0.25)
    assert 0.2 < below < 0.6
    # A right one below wrong ones is given where these are few.
    p, yes = np.append(p, 0.1), np.append(yes, 1.0)
    assert wrong_share_threshold(p, yes, np.ones(6), 0.34) == pytest.approx(0.1)


def test_wrong_share_threshold_without_a_kind_is_undecided() -> None:
    p = np.array([0.9, 0.2])
    assert wrong_share_threshold(p, np.ones(2), np.ones(2), 0.02) == UNDECIDED
    assert wrong_share_threshold(p, np.zeros(2), np.ones(2), 0.02) == UNDECIDED
    assert wrong_share_threshold(p, np.array([0.0, 1.0]), np.ones(2), 0.02) == 1.0


@given(
    st.lists(st.tuples(st.integers(1, 9), st.booleans(), st.integers(1, 3)), min_size=1),
    st.floats(0, 0.9),
)
def test_wrong_share_threshold_keeps_its_promise(
    rows: list[tuple[int, bool, int]], most_wrong: float
) -> None:
    p_N, yes_N, weight_N = (np.array(column, np.float64) for column in zip(*rows, strict=True))
    p_N /= 10
    if yes_N.all() or not yes_N.any():
        return
    given_N = p_N >= wrong_share_threshold(p_N, yes_N, weight_N, most_wrong)
    wrong = (weight_N * (1 - yes_N))[given_N].sum()
    assert wrong <= most_wrong * weight_N[given_N].sum() + 1e-9
