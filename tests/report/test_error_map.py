"""The map of errors: its scale near and far, its lines, and the list of farthest answers."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.geo import haversine_m
from pipeline.report.error_map import distance_chart, error_map
from pipeline.report.map_sheet import MAP_HEIGHT, MAP_WIDTH, MapSheet, format_metres

Position = tuple[float, float]


def query(
    place: str, at: Position, answer: str, answer_at: Position, number: int = 0
) -> dict[str, Any]:
    return {
        "query": f"{place}-{number}",
        "location": place,
        "first_match_rank": 1 if place == answer else 2,
        "top_locations": [answer],
        "lat": at[0],
        "lon": at[1],
        "answer_lat": answer_at[0],
        "answer_lon": answer_at[1],
        "distance_m": float(haversine_m(np.array(at), np.array(answer_at))),
    }


A, B, C = (30.0, 120.0), (30.0, 120.01), (30.005, 120.0)


def test_error_map_joins_a_place_with_its_wrong_answer() -> None:
    rows = [
        query("a", A, "a", A, 1),
        query("a", A, "b", B, 2),
        query("b", B, "b", B),
        query("c", C, "c", C),
    ]
    drawn = error_map("t", rows)
    assert drawn
    [arrow] = drawn.arrows
    at = {place.text.split(":")[0]: (place.x, place.y) for place in drawn.places}
    assert ((arrow.x1, arrow.y1), (arrow.x2, arrow.y2)) == (at["a"], at["b"])
    assert (arrow.text, arrow.right) == ("a taken for b, 963 m off, 1 of 2", False)
    assert [place.found for place in drawn.places] == [True, True, True]  # a: half of its queries
    assert at["a"][0] == at["c"][0] < at["b"][0]  # east is right
    assert at["c"][1] < at["a"][1] == at["b"][1]  # north is up


def test_error_map_shows_how_far_off_right_answers_are() -> None:
    """Two photos of one place, 481 m east and a metre north of its gallery image."""
    off, near = (30.0, 120.005), (30.00001, 120.0)
    drawn = error_map("t", [query("a", off, "a", A, 1), query("a", near, "a", A, 2)])
    assert drawn
    [arrow] = drawn.arrows  # the metre is below what the map can show
    assert arrow.right
    assert arrow.x1 > arrow.x2
    assert arrow.text == "a answered by an image of its own place, 481 m off, 1 of 2"
    assert "0 of 2 first answers are wrong" in drawn.summary


def test_map_sheet_bar_is_a_round_distance_to_scale() -> None:
    sheet = MapSheet.around(np.array([A, B, C]))
    length, label = sheet.bar()
    metres_across = (sheet.x(B[1]) - sheet.x(A[1])) / sheet.scale
    assert metres_across == pytest.approx(float(haversine_m(np.array(A), np.array(B))), rel=2e-3)
    assert label == "200 m"
    assert length / sheet.scale == pytest.approx(200, rel=1e-2)
    assert sheet.meridians() == ()  # too small for a grid of degrees


def test_map_sheet_joins_both_sides_of_the_180th_meridian() -> None:
    sheet = MapSheet.around(np.array([(-17.0, 179.0), (-18.0, -179.0), (-17.5, 178.0)]))
    assert sheet.wide == pytest.approx(3)
    assert sheet.x(178.0) < sheet.x(179.0) < sheet.x(-179.0)


@given(at=st.lists(st.tuples(st.floats(-89, 89), st.floats(-180, 180)), min_size=1, max_size=8))
def test_map_sheet_holds_every_place_on_earth(at: list[Position]) -> None:
    sheet = MapSheet.around(np.array(at))
    for x, y in sheet.xy(np.array(at)):
        assert -0.2 <= x <= MAP_WIDTH + 0.2
        assert -0.2 <= y <= MAP_HEIGHT + 0.2
    assert all(math.isfinite(tick.at) for tick in (*sheet.meridians(), *sheet.parallels()))
    assert 0 < sheet.bar()[0] <= MAP_WIDTH / 3 + 0.1


def test_map_sheet_of_the_world_has_meridians_and_parallels() -> None:
    sheet = MapSheet.around(np.array([(51.5, -0.1), (40.7, -74.0), (-33.9, 151.2)]))
    assert {"0°", "50° N"} <= {tick.label for tick in sheet.parallels()}
    assert [tick.label for tick in sheet.meridians()] == ["100° W", "0°", "100° E"]
    assert sheet.x(-74.0) < sheet.x(-0.1) < sheet.x(151.2)


def test_error_map_lists_the_worst_answer_of_each_place() -> None:
    far = [query("a", A, "b", (30 + k, 120.0), k) for k in range(1, 4)]
    drawn = error_map(
        "t",
        [
            *far,
            *(query(f"p{k}", A, "b", (30 + k / 10, 120.0)) for k in range(1, 9)),
            query("c", C, "c", C),
        ],
    )
    assert drawn
    assert [row["query"] for row in drawn.worst] == ["a-3", "p8-0", "p7-0", "p6-0", "p5-0"]


def test_error_map_without_positions_is_none() -> None:
    unknown = query("a", A, "b", B) | {"distance_m": None}
    assert error_map("t", [unknown]) is None
    assert distance_chart("t", [unknown]) is None
    assert error_map("t", [{"location": "a"}]) is None


def test_distance_chart_shows_the_share_within_a_distance() -> None:
    chart = distance_chart("t", [query("a", A, "a", A), query("a", A, "b", B)])
    assert chart
    assert chart.summary == "t: half within 481 m, the farthest 963 m off"
    shares = [y for _, y in chart.series[0].points]
    assert (shares[0], shares[-1]) == (0.5, 1.0)  # at 1 m and at the end


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0, "0 m"),
        (12.4, "12 m"),
        (1000, "1 km"),
        (1234, "1.2 km"),
        (9949, "9.9 km"),
        (3.4e6, "3,400 km"),
    ],
)
def test_format_metres_rounds_to_two_digits(value: float, text: str) -> None:
    assert format_metres(value) == text
