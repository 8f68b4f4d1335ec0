"""GeoJSON tables: shapes, positions over the date line, contradictions."""

import json
from pathlib import Path
from typing import Any

import pytest

from pipeline.core.records import GeoTag, ImageRecord, Rejection, View
from pipeline.sources.maps.geojson_shapes import centroid, order_footprint
from tests.sources.table_files import SQUARE, geojson, images, only, scan


def test_geojson_point_and_properties_become_a_record(tmp_path: Path) -> None:
    images(tmp_path, "1.jpg", "2.jpg", "3.jpg")
    table = geojson(
        tmp_path / "t.geojson",
        (
            {"type": "Point", "coordinates": [8.25, 47.5, 400]},
            {"path": "1.jpg", "heading_deg": 10, "lat": 47.5, "lon": 8.2501},
        ),
        (None, {"path": "2.jpg", "lat": 1, "lon": 2}),
        (None, {"path": "3.jpg", "location": 12, "view": "satellite"}),
    )
    first, second, third = scan(table)
    assert isinstance(first, ImageRecord)
    assert first.geotag == GeoTag(lat=47.5, lon=8.25, heading_deg=10)
    assert isinstance(second, ImageRecord)
    assert second.geotag == GeoTag(lat=1, lon=2)
    assert isinstance(third, ImageRecord)
    assert (third.geotag, third.location, third.view) == (None, "12", View.SATELLITE)


def test_geojson_polygon_is_a_footprint_around_its_centroid(tmp_path: Path) -> None:
    images(tmp_path, "1.jpg")
    polygon = {"type": "Polygon", "coordinates": [SQUARE]}
    tag = only(scan(geojson(tmp_path / "t.geojson", (polygon, {"path": "1.jpg"})))).geotag
    assert tag is not None
    assert (tag.lat, tag.lon) == pytest.approx((47.05, 8.1))
    assert tag.footprint == ((47.1, 8.0), (47.1, 8.2), (47.0, 8.2), (47.0, 8.0)), (
        "from the north-west, clockwise"
    )
    turned = only(
        scan(geojson(tmp_path / "t.json", (polygon, {"path": "1.jpg", "heading_deg": 90})))
    ).geotag
    assert turned is not None
    assert turned.footprint is not None
    assert turned.footprint[0] == (47.1, 8.2), "seen with east on top, the north-east is upper left"
    triangle = {"type": "Polygon", "coordinates": [[[0, 0], [3, 0], [0, 3], [0, 0]]]}
    tag = only(scan(geojson(tmp_path / "t.geojson", (triangle, {"path": "1.jpg"})))).geotag
    assert tag is not None
    assert (tag.lat, tag.lon) == pytest.approx((1, 1))
    assert tag.footprint is None


def test_centroid_of_a_field_of_a_metre_is_exact() -> None:
    corners = ((47.0, 8.0), (47.0, 8.00001), (47.00001, 8.00001), (47.00001, 8.0))
    assert centroid(corners) == pytest.approx((47.000005, 8.000005), abs=1e-12)
    assert order_footprint(corners, 180)[0] == (47.0, 8.00001)
    assert centroid(((1.0, 2.0), (3.0, 4.0))) == (2.0, 3.0), "no area"


@pytest.mark.parametrize(
    "geometry",
    [
        {"type": "LineString", "coordinates": [[0, 0], [1, 1]]},
        {"type": "Point", "coordinates": []},
        {"type": "Point", "coordinates": ["8", "47"]},
        {"type": "Point", "coordinates": [8, 95]},
        {"type": "Polygon"},
        {"type": "Polygon", "coordinates": [[]]},
        {"type": "Point", "coordinates": [10**400, 1]},
        [],
        "here",
        {"type": "Polygon", "coordinates": [[[0, 89], [1, 89], [1, 91], [0, 91], [0, 89]]]},
        {"type": "Point", "coordinates": [float("nan"), 1]},
    ],
)
def test_geojson_unusable_geometry_refuses_its_row(tmp_path: Path, geometry: Any) -> None:
    images(tmp_path, "1.jpg")
    [found] = scan(geojson(tmp_path / "t.geojson", (geometry, {"path": "1.jpg"})))
    assert isinstance(found, Rejection), found
    assert found.reason == "unreadable tag"
    assert found.found.startswith("row 1: ")


def test_geojson_malformed_features_miss_a_path(tmp_path: Path) -> None:
    images(tmp_path, "1.jpg")
    said = {
        "type": "FeatureCollection",
        "features": [7, {"properties": ["x"]}, {"properties": {"path": "1.jpg"}}],
    }
    first, second, third = scan(tmp_path / "t.geojson", json.dumps(said))
    assert all(
        isinstance(found, Rejection) and found.reason == "missing path" for found in (first, second)
    )
    assert isinstance(third, ImageRecord)


FIJI = [[179.999, -16.801], [-179.999, -16.801], [-179.999, -16.799], [179.999, -16.799]]
BEYOND = [[179.999, -16.801], [180.001, -16.801], [180.001, -16.799], [179.999, -16.799]]
BEFORE = [[-180.001, -16.801], [-179.999, -16.801], [-179.999, -16.799], [-180.001, -16.799]]


def closed(ring: list[list[float]]) -> list[list[float]]:
    return [*ring, ring[0]]


def halves(west: float, east: float) -> list[Any]:
    """FIJI cut at the date line, as RFC 7946 asks."""
    return [
        [closed([[179.999, -16.801], [west, -16.801], [west, -16.799], [179.999, -16.799]])],
        [closed([[east, -16.801], [-179.999, -16.801], [-179.999, -16.799], [east, -16.799]])],
    ]


@pytest.mark.parametrize(
    "geometry",
    [
        {"type": "Polygon", "coordinates": [closed(FIJI)]},
        {"type": "Polygon", "coordinates": [closed(FIJI)[::-1]]},
        {"type": "Polygon", "coordinates": [closed(BEYOND)]},
        {"type": "Polygon", "coordinates": [closed(BEFORE)]},
        {"type": "MultiPolygon", "coordinates": [[closed(FIJI)]]},
        {"type": "MultiPolygon", "coordinates": halves(180.0, -180.0)},
        {"type": "MultiPolygon", "coordinates": halves(180.0, -180.0)[::-1]},
    ],
)
def test_geojson_polygon_over_the_date_line_keeps_its_position(
    tmp_path: Path, geometry: Any
) -> None:
    images(tmp_path, "1.jpg")
    tag = only(scan(geojson(tmp_path / "t.geojson", (geometry, {"path": "1.jpg"})))).geotag
    assert tag is not None
    assert tag.lat == pytest.approx(-16.8, abs=1e-6)
    assert abs(tag.lon) == pytest.approx(180, abs=1e-6)
    expected = ((-16.799, 179.999), (-16.799, -179.999), (-16.801, -179.999), (-16.801, 179.999))
    assert tag.footprint is not None
    for corner, other in zip(tag.footprint, expected, strict=True):
        assert corner == pytest.approx(other, abs=1e-6)


@pytest.mark.parametrize(
    ("geometry", "found"),
    [
        (
            {"type": "MultiPolygon", "coordinates": [[SQUARE], [closed(FIJI)]]},
            "MultiPolygon of 2 separate parts, expected one",
        ),
        ({"type": "MultiPolygon", "coordinates": []}, "MultiPolygon without a part"),
        ({"type": "MultiPoint", "coordinates": [[8, 47], [9, 47]]}, "MultiPoint of 2 points"),
        (
            {"type": "Polygon", "coordinates": [[[-180, 80], [-60, 80], [60, 80], [-180, 80]]]},
            "Polygon around a pole",
        ),
        (
            {
                "type": "Polygon",
                "coordinates": [closed([[-180, -85], [180, -85], [180, 85], [-180, 85]])],
            },
            "Polygon around the whole Earth",
        ),
        ({"type": "Point", "coordinates": [500, 1]}, "Point with a longitude of 500"),
    ],
)
def test_geojson_shapes_without_one_position_are_refused(
    tmp_path: Path, geometry: Any, found: str
) -> None:
    images(tmp_path, "1.jpg")
    [refused] = scan(geojson(tmp_path / "t.geojson", (geometry, {"path": "1.jpg"})))
    assert isinstance(refused, Rejection)
    assert refused.found.startswith(f"row 1: {found}")


def test_geojson_corners_in_a_crossed_order_are_one_footprint(tmp_path: Path) -> None:
    images(tmp_path, "1.jpg")
    crossed = [SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3], SQUARE[0]]
    tags = [
        only(
            scan(
                geojson(
                    tmp_path / "t.geojson",
                    ({"type": "Polygon", "coordinates": [ring]}, {"path": "1.jpg"}),
                )
            )
        ).geotag
        for ring in (SQUARE, crossed)
    ]
    assert tags[0] is not None
    assert tags[1] is not None
    assert tags[0].footprint == tags[1].footprint
    assert (tags[1].lat, tags[1].lon) == pytest.approx((tags[0].lat, tags[0].lon))


@pytest.mark.parametrize(
    ("geometry", "columns", "agree"),
    [
        ({"type": "Point", "coordinates": [8.25, 47.5]}, {"lat": 47.5003, "lon": 8.2502}, True),
        ({"type": "Point", "coordinates": [8.25, 47.5]}, {"lat": 8.25, "lon": 47.5}, False),
        ({"type": "Point", "coordinates": [8.25, 47.5]}, {"lat": -47.5, "lon": 8.25}, False),
        ({"type": "Point", "coordinates": [8.25, 47.5]}, {"lat": "NA", "lon": "NA"}, True),
        ({"type": "Point", "coordinates": [8.25, 47.5]}, {"lat": "north", "lon": 8.25}, True),
        ({"type": "Polygon", "coordinates": [SQUARE]}, {"lat": 47.02, "lon": 8.12}, True),
        ({"type": "Polygon", "coordinates": [SQUARE]}, {"lat": 47.05, "lon": -8.1}, False),
    ],
)
def test_geojson_geometry_is_compared_with_lat_and_lon(
    tmp_path: Path, geometry: Any, columns: dict[str, Any], agree: bool
) -> None:
    images(tmp_path, "1.jpg")
    [found] = scan(geojson(tmp_path / "t.geojson", (geometry, {"path": "1.jpg"} | columns)))
    if agree:
        assert isinstance(found, ImageRecord)
        assert found.geotag is not None
    else:
        assert isinstance(found, Rejection)
        assert found.reason == "contradicting positions"
