"""Planning tiles: every pixel is covered, and nothing outside."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.sources.maps.tiles import parse_window, plan_tiles, tile_starts


@given(
    st.integers(1, 90),
    st.integers(1, 90),
    st.integers(1, 40),
    st.integers(1, 40),
    st.floats(0, 0.95),
)
def test_plan_tiles_covers_every_pixel_and_stays_inside(
    width: int, height: int, across: int, down: int, overlap: float
) -> None:
    planned = plan_tiles((width, height), (across, down), overlap)
    covered_HW = np.zeros((height, width), bool)
    for tile in planned:
        window = tile.window
        assert min(window.x, window.y) >= 0
        assert (window.width, window.height) == (min(across, width), min(down, height))
        assert window.x + window.width <= width
        assert window.y + window.height <= height
        covered_HW[window.y : window.y + window.height, window.x : window.x + window.width] = True
        assert parse_window(window.part) == window
    assert covered_HW.all()
    assert (
        len({tile.window for tile in planned})
        == len({(tile.row, tile.column) for tile in planned})
        == len(planned)
    )
    assert plan_tiles((width, height), (across, down), overlap) == planned


@given(st.integers(1, 5000), st.integers(1, 600), st.floats(0, 0.95))
def test_tile_starts_overlap_and_end_at_the_border(length: int, side: int, overlap: float) -> None:
    begins = tile_starts(length, side, overlap)
    steps = np.diff(begins)
    assert set(steps[:-1]) <= {max(1, round(side * (1 - overlap)))}
    assert all(0 < step <= max(1, round(side * (1 - overlap))) for step in steps)
    assert begins[-1] + side == length or (begins == [0] and side > length)


def test_tile_starts_hand_worked() -> None:
    assert tile_starts(1000, 400, 0.25) == [0, 300, 600]
    assert tile_starts(1001, 400, 0.25) == [0, 300, 600, 601]
    assert tile_starts(399, 400, 0.25) == [0]
    with pytest.raises(ValueError, match="is no window"):
        parse_window("x1-y2")
