"""Tables of images: every format says the same, every bad row is refused by its number, a bad file
by a sentence.
"""

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import fsspec
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import GeoTag, ImageRecord, Rejection, Split, View
from pipeline.sources import source_class
from pipeline.sources.maps.geojson_shapes import centroid, order_footprint
from pipeline.sources.table import Table

SQUARE = [[8.0, 47.0], [8.2, 47.0], [8.2, 47.1], [8.0, 47.1], [8.0, 47.0]]
"Counter-clockwise from the south-west, longitude first, as RFC 7946 has it."


def images(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"12345")


def scan(
    path: Path, text: str | bytes | None = None, **changes: Any
) -> list[ImageRecord | Rejection]:
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return list(Table(**changes).scan(str(path)))


def only(found: list[ImageRecord | Rejection]) -> ImageRecord:
    [record] = found
    assert isinstance(record, ImageRecord), record
    return record


def geojson(path: Path, *features: tuple[Any, Any], **members: Any) -> Path:
    said = [
        {"type": "Feature", "geometry": geometry, "properties": properties}
        for geometry, properties in features
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": said} | members))
    return path


def test_a_row_of_csv_becomes_a_record(tmp_path: Path) -> None:
    images(tmp_path, "flug/été 1.JPG")
    text = (
        "path,view,split,location,lat,lon,altitude_m,heading_deg,pitch_deg,taken_at,operator\n"
        "flug/été 1.JPG,Satellite,gallery,0001,-33.5,-70.75,100,-90,-45,2024-05-01T12:34:56+02:00,me\n"
    )
    record = only(scan(tmp_path / "t.csv", text))
    assert record == ImageRecord(
        path=str(tmp_path / "flug/été 1.JPG"),
        view=View.SATELLITE,
        split=Split.GALLERY,
        location="0001",
        bytes=5,
        geotag=GeoTag(lat=-33.5, lon=-70.75, altitude_m=100, heading_deg=270, pitch_deg=-45),
        taken_at="2024-05-01T12:34:56+02:00",
    )
    assert source_class("table") is Table


def test_a_path_is_enough_and_settings_say_the_rest(tmp_path: Path) -> None:
    images(tmp_path, "a/007.jpg")
    record = only(
        scan(tmp_path / "t.csv", "path\na/007.jpg\n", view=View.SATELLITE, split=Split.TRAIN)
    )
    assert (record.view, record.split, record.location, record.geotag) == (
        View.SATELLITE,
        Split.TRAIN,
        "007",
        None,
    )


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_delimiters_a_bom_aliases_and_case_are_understood(
    tmp_path: Path, delimiter: str, encoding: str
) -> None:
    images(tmp_path, "ö 1.jpg")
    text = '"Path",Latitude,LNG\r\n\r\n"ö 1.jpg",47.5,8.25\r\n'.replace(",", delimiter)
    tag = only(scan(tmp_path / "t.csv", text.encode(encoding))).geotag
    assert tag == GeoTag(lat=47.5, lon=8.25)


def test_a_decimal_comma_is_understood_where_commas_do_not_part_cells(tmp_path: Path) -> None:
    images(tmp_path, "1.jpg")
    assert only(scan(tmp_path / "t.csv", "path;lat;lon\n1.jpg;47,5;8,25\n")).geotag == GeoTag(
        lat=47.5, lon=8.25
    )
    [refused] = scan(tmp_path / "t.csv", 'path,lat,lon\n1.jpg,"47,5",8\n')
    assert isinstance(refused, Rejection)
    assert refused.found == "row 1: lat 47,5"


def test_every_bad_row_is_refused_with_its_number_and_the_rest_is_kept(tmp_path: Path) -> None:
    images(tmp_path, "1.jpg", "notes.docx")
    rows = [
        "1.jpg,drone,query,47,8,,",
        "1.jpg,drone,query,95,8,,",
        "1.jpg,drone,query,inf,8,,",
        "1.jpg,drone,query,,8,,",
        ",drone,query,47,8,,",
        "2.jpg,drone,query,47,8,,",
        "1.jpg,dron,query,47,8,,",
        "1.jpg,drone,test,47,8,,",
        "notes.docx,drone,query,47,8,,",
        "1.jpg,drone,query,47,8,-91,",
        "1.jpg,drone,query,47,8,,yesterday",
        "1,jpg,drone,query,47,8,,",
        "1.jpg",
        "1.jpg,drone,query,x,8,,",
    ]
    found = scan(
        tmp_path / "t.csv", "\n".join(["path,view,split,lat,lon,pitch_deg,taken_at", *rows])
    )
    assert isinstance(found[0], ImageRecord)
    assert [
        (r.reason, r.found.partition(":")[0]) for r in found[1:] if isinstance(r, Rejection)
    ] == [
        ("unreadable tag", "row 2"),
        ("unreadable tag", "row 3"),
        ("unreadable tag", "row 4"),
        ("missing path", "row 5"),
        ("no such file", "row 6"),
        ("unknown view", "row 7"),
        ("unknown split", "row 8"),
        ("not an image's name", "row 9"),
        ("unreadable tag", "row 10"),
        ("unreadable tag", "row 11"),
        ("wrong number of cells", "row 12"),
        ("wrong number of cells", "row 13"),
        ("unreadable tag", "row 14"),
    ]
    assert isinstance(found[4], Rejection)
    assert found[4].path == str(tmp_path / "t.csv"), "a row without a path is named by its table"
    assert isinstance(found[1], Rejection)
    assert found[1].found == "row 2: position: latitude 95.0, longitude 8.0"


def test_no_position_is_fine_and_neither_is_zero_zero_one(tmp_path: Path) -> None:
    images(tmp_path, "1.jpg")
    found = scan(tmp_path / "t.csv", "path,lat,lon\n1.jpg,,\n1.jpg,nan,NaN\n1.jpg,0,0.0\n")
    assert [record.geotag for record in found if isinstance(record, ImageRecord)] == [None] * 3


def test_paths_may_be_absolute_or_uris_and_remote_ones_are_not_asked_for(tmp_path: Path) -> None:
    images(tmp_path, "1.jpg")
    text = f"path\n{tmp_path}/1.jpg\nfile://{tmp_path}/1.jpg\nmemory://bucket/2.jpg\nfile://{tmp_path}/3.jpg\nnul\0.jpg\n"
    (tmp_path / "sub").mkdir()
    found = scan(tmp_path / "sub/t.csv", text)
    assert [f.bytes if isinstance(f, ImageRecord) else f.reason for f in found] == [
        5,
        5,
        None,
        "no such file",
        "no such file",
    ]


def test_a_table_on_an_object_store_names_images_beside_it() -> None:
    fsspec.filesystem("memory").rm("/", recursive=True)
    storage.write_bytes("memory://bucket/set/t.csv", b"path\na/1.jpg\n")
    record = only(list(Table().scan("memory://bucket/set/t.csv")))
    assert (record.path, record.bytes) == ("memory://bucket/set/a/1.jpg", None)


def test_a_bare_file_name_is_a_table_in_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    images(tmp_path, "1.jpg")
    (tmp_path / "t.csv").write_text("path\n1.jpg\n")
    monkeypatch.chdir(tmp_path)
    assert only(list(Table().scan("t.csv"))).bytes == 5


def test_parquet_says_the_same_with_types_of_its_own(tmp_path: Path) -> None:
    images(tmp_path, "1.jpg", "2.jpg")
    pq.write_table(
        pa.table(
            {
                "path": ["1.jpg", "2.jpg"],
                "location": [7, 8],
                "latitude": [47.5, None],
                "longitude": [8.25, None],
                "view": pa.array(["drone", None]).dictionary_encode(),
                "cloud": [0.5, 0.1],
                "taken_at": pa.array(
                    [datetime(2024, 5, 1, 12, tzinfo=UTC), None], pa.timestamp("ms", "UTC")
                ),
            }
        ),
        tmp_path / "t.parquet",
    )
    first, second = scan(tmp_path / "t.parquet")
    assert isinstance(first, ImageRecord)
    assert isinstance(second, ImageRecord)
    assert (first.location, first.geotag, first.taken_at) == (
        "7", GeoTag(lat=47.5, lon=8.25), "2024-05-01T12:00:00+00:00",
    )  # fmt: skip
    assert (second.location, second.geotag, second.taken_at, second.view) == (
        "8",
        None,
        None,
        View.DRONE,
    )


def test_what_pandas_writes_for_nothing_is_nothing(tmp_path: Path) -> None:
    images(tmp_path, "1.jpg")
    frame = pd.DataFrame(
        {"path": ["1.jpg"], "lat": [float("nan")], "lon": [float("nan")], "location": [None]}
    )
    columns = {
        name: pa.array(frame[name].tolist(), from_pandas=False) for name in ("path", "lat", "lon")
    }
    pq.write_table(pa.table(columns), tmp_path / "t.parquet")  # NaN and not null
    assert only(scan(tmp_path / "t.parquet")).geotag is None
    frame.to_csv(tmp_path / "t.csv")
    assert only(scan(tmp_path / "t.csv")).geotag is None
    frame.to_parquet(tmp_path / "t.parquet")
    assert only(scan(tmp_path / "t.parquet")).location == "1"


def test_geojson_has_longitude_first_and_its_properties_carry_the_rest(tmp_path: Path) -> None:
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


def test_a_polygon_is_a_footprint_around_its_centroid(tmp_path: Path) -> None:
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


def test_the_middle_of_a_field_of_a_metre_is_exact() -> None:
    corners = ((47.0, 8.0), (47.0, 8.00001), (47.00001, 8.00001), (47.00001, 8.0))
    assert centroid(corners) == pytest.approx((47.000005, 8.000005), abs=1e-12)
    assert order_footprint(corners, 180)[0] == (47.0, 8.00001)
    assert centroid(((1.0, 2.0), (3.0, 4.0))) == (2.0, 3.0), "no area"


@pytest.mark.parametrize(
    "geometry",
    [
        {"type": "LineString", "coordinates": [[0, 0], [1, 1]]}, {"type": "Point", "coordinates": []},
        {"type": "Point", "coordinates": ["8", "47"]}, {"type": "Point", "coordinates": [8, 95]}, {"type": "Polygon"},
        {"type": "Polygon", "coordinates": [[]]}, {"type": "Point", "coordinates": [10**400, 1]}, [], "here",
        {"type": "Polygon", "coordinates": [[[0, 89], [1, 89], [1, 91], [0, 91], [0, 89]]]},
        {"type": "Point", "coordinates": [float("nan"), 1]},
    ],
)  # fmt: skip
def test_a_geometry_that_is_no_place_refuses_its_row(tmp_path: Path, geometry: Any) -> None:
    images(tmp_path, "1.jpg")
    [found] = scan(geojson(tmp_path / "t.geojson", (geometry, {"path": "1.jpg"})))
    assert isinstance(found, Rejection), found
    assert found.reason == "unreadable tag"
    assert found.found.startswith("row 1: ")


def test_features_that_are_none_miss_a_path(tmp_path: Path) -> None:
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


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("t.csv", b"file,lat,lon\n1.jpg,1,2\n", r"no column path but file, lat, lon; expected path and any of view"),
        ("t.csv", b"path,lat\n1.jpg,1\n", "no column lon but path, lat"),
        ("t.csv", b"path,lat,latitude,lon\n1.jpg,1,1,1\n", "two columns for lat"),
        ("t.csv", "path\nübung.jpg\n".encode("latin-1"), r"is not UTF-8 \(byte 0xfc\).*save it again as UTF-8"),
        ("t.csv", "path\n1.jpg\n".encode("utf-16"), "is not UTF-8"),
        ("t.csv", b"", "no column path but none"),
        ("t.csv", b"path,lat,lon\n", "has no rows"),
        ("t.csv", b"path\n" + b"x" * 200_000, "cannot be read as CSV"),
        ("t.parquet", b"PAR1 not really", "cannot be read as Parquet"),
        ("t.geojson", b"{", "cannot be read as JSON"),
        ("t.geojson", b"[" * 200_000, "cannot be read as JSON"),
        ("t.geojson", b'{"type": "Feature"}', "holds no FeatureCollection"),
        ("t.geojson", b'{"type": "FeatureCollection", "features": []}', "has no rows"),
        ("t.geojson", b'{"type": "FeatureCollection", "features": [{"properties": {"file": "1.jpg"}}]}', "no column path"),
        ("t.geojson", b'{"type": "FeatureCollection", "features": [], "crs": {"properties": {"name": "EPSG:2056"}}}',
         "expected longitude and latitude, WGS84; reproject it"),
        ("t.xlsx", b"PK", r"no table by its name, expected .csv, .tsv, .parquet, .geojson, .json"),
    ],
)  # fmt: skip
def test_an_unusable_file_is_refused_with_one_sentence(
    tmp_path: Path, name: str, text: bytes, sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        scan(tmp_path / name, text)


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no file .*t.csv; expected a table of images"):
        scan(tmp_path / "t.csv")
    with pytest.raises(InputError, match="is a folder, expected a table of images"):
        scan(tmp_path)
