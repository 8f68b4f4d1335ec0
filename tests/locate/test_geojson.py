"""The files of answers for other programs: GeoJSON and CSV."""

import csv
import io
import json

from pipeline.core.records import Rejection, View
from pipeline.index.searcher import Hit
from pipeline.locate.geojson import CSV_COLUMNS, LocatedPhoto, to_csv, to_geojson
from pipeline.locate.locate import Answer, Position

HIT = Hit(
    key="gallery-satellite-1", location="1", view=View.SATELLITE, lat=46.0, lon=8.0, score=0.75
)


def answer(known: bool = True, lat: float = 46.0) -> Answer:
    return Answer(
        position=Position(lat=lat, lon=8.0, radius_m=20.0),
        location="1",
        probability=0.5,
        known=known,
        candidates=(HIT,),
        agreeing=1,
    )


FOUND = LocatedPhoto(name="a.jpg", photos=("a.jpg",), answer=answer(), taken_at="10")
UNKNOWN = LocatedPhoto(name="b.jpg", photos=("b.jpg",), answer=answer(known=False), taken_at="20")
DAMAGED = LocatedPhoto(
    name="c.jpg",
    photos=("c.jpg",),
    rejected=(Rejection(path="c.jpg", reason="empty file", found="0 bytes"),),
)
LATER = LocatedPhoto(name="d.jpg", photos=("d.jpg",), answer=answer(lat=47.0), taken_at="30")


def test_geojson_known_answer_is_a_point() -> None:
    collection = json.loads(to_geojson([FOUND], {"index": "i"}, track=False))
    assert collection["type"] == "FeatureCollection"
    assert collection["pvda"] == {"index": "i"}
    (feature,) = collection["features"]
    assert feature["geometry"] == {"type": "Point", "coordinates": [8.0, 46.0]}
    assert feature["properties"]["radius_m"] == 20
    assert feature["properties"]["candidates"] == [
        {
            "key": "gallery-satellite-1",
            "location": "1",
            "view": "satellite",
            "lat": 46.0,
            "lon": 8.0,
            "score": 0.75,
            "side_m": None,
        }
    ]


def test_geojson_unknown_answer_has_no_geometry() -> None:
    (feature,) = json.loads(to_geojson([UNKNOWN], {}, track=False))["features"]
    assert feature["geometry"] is None
    assert (feature["properties"]["known"], feature["properties"]["lat"]) == (False, 46.0)


def test_geojson_lists_rejected_photos() -> None:
    (feature,) = json.loads(to_geojson([DAMAGED], {}, track=False))["features"]
    assert feature["geometry"] is None
    assert feature["properties"]["rejected"] == [
        {"path": "c.jpg", "reason": "empty file", "found": "0 bytes"}
    ]


def test_geojson_track_is_a_line_of_known_answers() -> None:
    line = json.loads(to_geojson([FOUND, UNKNOWN, LATER], {}, track=True))["features"][0]
    assert line["geometry"] == {"type": "LineString", "coordinates": [[8.0, 46.0], [8.0, 47.0]]}
    assert line["properties"]["times"] == ["10", "30"]


def test_geojson_track_of_one_point_has_no_geometry() -> None:
    assert (
        json.loads(to_geojson([FOUND, UNKNOWN], {}, track=True))["features"][0]["geometry"] is None
    )


def test_csv_has_a_row_per_answer() -> None:
    rows = list(csv.DictReader(io.StringIO(to_csv([FOUND, DAMAGED]).decode())))
    assert tuple(rows[0]) == CSV_COLUMNS
    assert (rows[0]["known"], rows[0]["lat"], rows[0]["candidate"]) == (
        "true",
        "46.0",
        "gallery-satellite-1",
    )
    assert (rows[1]["known"], rows[1]["lat"], rows[1]["reason"]) == ("false", "", "empty file")


def test_geojson_and_csv_keep_non_unicode_names() -> None:
    name = b"caf\xe9.jpg".decode("utf-8", "surrogateescape")
    odd = LocatedPhoto(name=name, photos=(name,), answer=answer())
    assert b"caf\xe9.jpg" in to_csv([odd])
    assert (
        json.loads(to_geojson([odd], {}, track=False))["features"][0]["properties"]["photo"] == name
    )
