"""Evenly spaced samples."""

import pytest

from pipeline.core.arrays import evenly_spaced


@pytest.mark.parametrize(
    ("count", "most", "numbers"),
    [(0, 3, []), (1, 3, [0]), (3, 5, [0, 1, 2]), (5, 3, [0, 2, 4]), (10, 4, [0, 3, 6, 9])],
)
def test_evenly_spaced_by_hand(count: int, most: int, numbers: list[int]) -> None:
    assert evenly_spaced(count, most).tolist() == numbers
