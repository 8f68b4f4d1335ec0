"""Filters: each condition against a loop over the rows, corners and poles included."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.errors import InputError
from pipeline.core.filters import Filter
from pipeline.core.geo import Box, Circle, haversine_m
from pipeline.core.records import View

LATS = [0.0, 10.0, -10.0, 89.9999, None]
LONS = [179.999, 20.0, -179.0, 0.0, None]


def rows_of(
    lats: Sequence[float | None], lons: Sequence[float | None], views: list[str], names: list[str]
) -> pa.RecordBatch:
    columns = [
        pa.array(lats, pa.float64()),
        pa.array(lons, pa.float64()),
        pa.array(views),
        pa.array(names),
    ]
    return pa.RecordBatch.from_arrays(columns, ["lat", "lon", "view", "location"])


def meant(where: Filter) -> list[int]:
    rows = rows_of(LATS, LONS, ["satellite"] * 4 + ["drone"], ["a", "b", "c", "a", "b"])
    return np.flatnonzero(where.mask(rows)).tolist()


def test_filter_without_conditions_allows_every_row() -> None:
    assert meant(Filter()) == [0, 1, 2, 3, 4]


def test_filter_conditions_alone_and_combined() -> None:
    assert meant(Filter(view=View.DRONE)) == [4]
    assert meant(Filter(view=View.STREET)) == []
    assert meant(Filter(locations=frozenset(["a", "unheard-of"]))) == [0, 3]
    assert meant(Filter(locations=frozenset())) == []
    assert meant(Filter(box=Box(south=-90, north=90, west=170, east=-170))) == [0, 2], (
        "over the meridian of 180 degrees"
    )
    assert meant(Filter(near=Circle(lat=0, lon=-179.999, radius_m=300))) == [0], (
        "222 m over that meridian"
    )
    assert meant(Filter(near=Circle(lat=89.9999, lon=180, radius_m=30))) == [3], (
        "22 m over the pole"
    )
    together = Filter(
        view=View.SATELLITE,
        locations=frozenset("a"),
        box=Box(south=-1, north=1, west=-180, east=180),
    )
    assert meant(together) == [0]


def test_row_without_position_is_outside_box_and_circle() -> None:
    assert 4 not in meant(Filter(box=Box(south=-90, north=90, west=-180, east=180)))
    assert 4 not in meant(Filter(near=Circle(lat=0, lon=0, radius_m=3e7)))


@given(
    st.lists(st.tuples(st.floats(-90, 90), st.floats(-180, 180)), min_size=1, max_size=8),
    st.floats(-90, 90), st.floats(-180, 180), st.floats(1, 2.1e7),
)  # fmt: skip
def test_circle_contains_rows_within_its_radius(
    places: list[tuple[float, float]], lat: float, lon: float, radius: float
) -> None:
    places_N2 = np.array(places)
    rows = rows_of(
        [lat for lat, _ in places],
        [lon for _, lon in places],
        ["drone"] * len(places),
        ["a"] * len(places),
    )
    found_N = Filter(near=Circle(lat=lat, lon=lon, radius_m=radius)).mask(rows)
    assert np.array_equal(found_N, haversine_m(places_N2, np.array([lat, lon])) <= radius)


PLACES = st.lists(
    st.tuples(st.none() | st.floats(-90, 90), st.floats(-180, 180), st.sampled_from("abc")),
    min_size=1,
    max_size=6,
)


@st.composite
def filters(draw: st.DrawFn) -> Filter:
    box = near = None
    if draw(st.booleans()):
        south, north = sorted([draw(st.floats(-90, 90)), draw(st.floats(-90, 90))])
        box = Box(
            south=south,
            north=north,
            west=draw(st.floats(-180, 180)),
            east=draw(st.floats(-180, 180)),
        )
    if draw(st.booleans()):
        near = Circle(
            lat=draw(st.floats(-90, 90)),
            lon=draw(st.floats(-180, 180)),
            radius_m=draw(st.floats(1, 2.1e7)),
        )
    return Filter(
        view=draw(st.none() | st.sampled_from([View.DRONE, View.SATELLITE])),
        locations=draw(st.none() | st.frozensets(st.sampled_from("abcd"), max_size=2)),
        box=box,
        near=near,
    )


@given(PLACES, filters())
def test_bounds_never_leave_out_a_matching_row(
    places: list[tuple[float | None, float, str]], where: Filter
) -> None:
    lats, lons, names = zip(*places, strict=True)
    rows = rows_of(lats, lons, ["drone"] * len(places), list(names))
    ends = {name: pc.min_max(rows[name]).as_py() for name in rows.schema.names}

    def bounds(name: str) -> tuple[Any, Any] | None:
        return None if ends[name]["min"] is None else (ends[name]["min"], ends[name]["max"])

    assert where.may_match(bounds) or not where.mask(rows).any()


def test_bounds_leave_out_rows_far_from_the_conditions() -> None:
    known = {"lat": (47.0, 48.0), "lon": (8.0, 9.0), "view": ("drone", "drone")}
    known["location"] = ("b", "d")

    def may_match(**conditions: Any) -> bool:
        return Filter(**conditions).may_match(known.get)

    assert may_match(box=Box(south=47.5, north=50, west=8.5, east=20))
    assert not may_match(box=Box(south=48.1, north=50, west=8.5, east=20))
    assert not may_match(box=Box(south=47.5, north=50, west=9.1, east=-170))
    assert may_match(near=Circle(lat=48.001, lon=8.5, radius_m=200))
    assert not may_match(near=Circle(lat=48.01, lon=8.5, radius_m=200))
    assert not may_match(view=View.SATELLITE)
    assert may_match(locations=frozenset(["a", "c"]))
    assert not may_match(locations=frozenset(["a", "e"]))
    assert Filter(box=Box(south=0, north=1, west=0, east=1)).may_match(lambda name: None)


@pytest.mark.parametrize(
    ("lat", "lon", "radius"),
    [(91, 0, 1), (0, 181, 1), (0, 0, 0), (0, 0, float("nan")), (0, 0, float("inf"))],
)
def test_circle_rejects_invalid_values(lat: float, lon: float, radius: float) -> None:
    with pytest.raises(InputError, match="expected a latitude from -90 to 90"):
        Circle(lat=lat, lon=lon, radius_m=radius)
