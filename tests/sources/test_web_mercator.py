"""The grid of web maps: tiles lie where Web Mercator has them."""

import math

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.sources.maps.web_mercator import is_on_grid, tile_geotag, tile_to_degrees
from tests.sources.tile_sets import EDGE


def test_tile_geotag_of_zoom_0_is_the_world() -> None:
    tag = tile_geotag(0, 0, 0)
    assert (tag.lat, tag.lon) == (0, 0)
    assert tag.footprint is not None
    assert np.allclose(
        tag.footprint, [(EDGE, -180), (EDGE, 180), (-EDGE, 180), (-EDGE, -180)], rtol=0, atol=1e-12
    )
    assert math.degrees(math.atan(math.sinh(math.pi))) == pytest.approx(EDGE, abs=1e-12)


@pytest.mark.parametrize(
    ("x", "y", "lat", "lon"), [(0, 0, 1, -90), (1, 0, 1, 90), (0, 1, -1, -90), (1, 1, -1, 90)]
)
def test_tile_geotag_of_zoom_1(x: int, y: int, lat: int, lon: int) -> None:
    tag = tile_geotag(1, x, y)
    assert tag.lon == lon
    # The middle on the map, a quarter of the way round: atan(sinh(pi / 2)); the middle in degrees
    # would be 42.5.
    assert tag.lat == pytest.approx(lat * 66.51326044311186, abs=1e-12)
    assert tag.footprint is not None
    assert sorted({abs(place[0]) for place in tag.footprint}) == pytest.approx([0, EDGE])


def test_tile_geotag_hand_worked_at_the_brandenburg_gate() -> None:
    corners = tile_geotag(15, 17601, 10746).footprint
    assert corners is not None
    (north, west), _, (south, east), _ = corners
    assert (west, east) == (
        13.370361328125,
        13.38134765625,
    )  # 17601 and 17602 times 360 / 32768, less 180
    assert south < 52.51628 < north
    assert north - south == pytest.approx(
        (east - west) * math.cos(math.radians(52.52)), rel=1e-3
    )  # square on the ground


@given(st.integers(0, 22), st.floats(0, 1), st.floats(0, 1))
def test_tile_to_degrees_matches_pyproj(zoom: int, x: float, y: float) -> None:
    half = math.pi * 6378137
    to_wgs84 = pyproj.Transformer.from_crs("EPSG:3857", "EPSG:4326", always_xy=True)
    lon, lat = to_wgs84.transform((2 * x - 1) * half, (1 - 2 * y) * half)
    said = tile_to_degrees(zoom, x * 2**zoom, y * 2**zoom)
    assert said[0] == pytest.approx(lat, abs=1e-9)
    assert (said[1] - lon) % 360 == pytest.approx(0, abs=1e-9) or abs(
        (said[1] - lon) % 360 - 360
    ) < 1e-9


def test_is_on_grid_beyond_the_grid() -> None:
    assert is_on_grid(3, 7, 0)
    assert not is_on_grid(3, 8, 0)
    assert not is_on_grid(3, 0, -1)
