"""CSV, Parquet, GeoJSON, text and JSON lists from anybody: rows, refused rows, or a sentence why
there are none.
"""

import csv
import io
import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.errors import InputError
from pipeline.core.records import ImageRecord, Rejection
from pipeline.sources.denseuav import parse_line, read_gps_tables
from pipeline.sources.gta_uav import GtaUav
from pipeline.sources.maps import mbtiles
from pipeline.sources.table import Table
from pipeline.sources.text_tables import Unreadable, read_rows
from pipeline.sources.university1652 import University1652
from pipeline.sources.visloc_maps import read_corners, read_maps
from pipeline.sources.xyz import Xyz
from tests.fuzz.bounds import bounded, examples
from tests.fuzz.hostile import damaged, names, numbers, twisted, values

COLUMNS = (
    "path",
    "view",
    "split",
    "location",
    "lat",
    "lon",
    "altitude_m",
    "heading_deg",
    "pitch_deg",
    "taken_at",
)
ROW = ("a.jpg", "drone", "query", "0001", "47.5", "8.5", "100", "10", "-90", "2024-05-06T07:08:09")
PAIR = {
    "drone_img_dir": "drone/images",
    "drone_img_name": "a.png",
    "pair_pos_sate_img_list": ["t.png", "u.png"],
    "pair_pos_sate_weight_list": [0.5, 0.25],
    "pair_pos_semipos_sate_img_list": ["t.png"],
    "pair_pos_semipos_sate_weight_list": [0.5],
}
RING = [[[8.0, 47.0], [8.1, 47.0], [8.1, 47.1], [8.0, 47.1], [8.0, 47.0]]]
GEOJSON = {
    "type": "FeatureCollection",
    "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}},
    "features": [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [8.5, 47.5]},
            "properties": dict(zip(COLUMNS, ROW, strict=True)),
        },
        {
            "type": "Feature",
            "geometry": {"type": "Polygon", "coordinates": RING},
            "properties": {"path": "b.jpg", "heading_deg": 10},
        },
    ],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("tables")
    (found / "a.jpg").write_bytes(b"x")
    return found


def scanned(table: Path) -> list[ImageRecord | Rejection]:
    found: list[ImageRecord | Rejection] = []
    with bounded(InputError):
        found.extend(Table().scan(str(table)))
    for item in found:
        if isinstance(item, ImageRecord) and item.geotag is not None:
            assert abs(item.geotag.lat) <= 90
            assert abs(item.geotag.lon) <= 180
    return found


cells = numbers | names | st.sampled_from(ROW)


@given(
    st.lists(st.lists(cells, min_size=9, max_size=11), max_size=4),
    st.sampled_from(",;\t"),
    st.data(),
)
@examples(60)
def test_a_csv(folder: Path, rows: list[list[str]], delimiter: str, data: st.DataObject) -> None:
    text = io.StringIO()
    writer = csv.writer(text, delimiter=delimiter, escapechar="\\")
    writer.writerows([COLUMNS, ROW, *rows])
    encoding = data.draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "latin-1"]))
    told = text.getvalue().encode(
        encoding, "surrogatepass" if encoding.startswith("utf") else "replace"
    )
    (folder / "t.csv").write_bytes(data.draw(damaged(told)) if data.draw(st.booleans()) else told)
    scanned(folder / "t.csv")
    with bounded(InputError):
        list(read_rows(str(folder / "t.csv"), ("path", "lat")))


@given(twisted(GEOJSON), st.data())
@examples(80)
def test_a_geojson(folder: Path, value: Any, data: st.DataObject) -> None:
    told = json.dumps(value).encode()
    (folder / "t.geojson").write_bytes(
        data.draw(damaged(told)) if data.draw(st.booleans()) else told
    )
    scanned(folder / "t.geojson")


def test_a_geojson_deeper_than_any_reader(folder: Path) -> None:
    for depth in (900, 960, 980, 990, 100_000):
        deep = "[" * depth + "]" * depth
        (folder / "t.geojson").write_text(
            f'{{"type": "FeatureCollection", "features": [{{"properties": {{"path": {deep}}}, "geometry": {deep}}}]}}'
        )
        scanned(folder / "t.geojson")


ARROW = [
    pa.string(),
    pa.large_string(),
    pa.binary(),
    pa.int8(),
    pa.uint64(),
    pa.float16(),
    pa.float64(),
    pa.bool_(),
    pa.null(),
    pa.timestamp("ns"),
    pa.timestamp("s"),
    pa.timestamp("us", "Europe/Zurich"),
    pa.timestamp("us", "No/Where"),
    pa.date32(),
    pa.date64(),
    pa.time64("ns"),
    pa.duration("ns"),
    pa.decimal128(38, 10),
    pa.list_(pa.string()),
    pa.struct([("path", pa.string())]),
    pa.dictionary(pa.int32(), pa.string()),
    pa.map_(pa.string(), pa.string()),
    pa.binary_view(),
    pa.month_day_nano_interval(),
]


@given(
    st.dictionaries(
        st.sampled_from(COLUMNS),
        st.tuples(st.sampled_from(ARROW), st.binary(min_size=64, max_size=64)),
    ),
    st.data(),
)
@examples(60)
def test_a_parquet_of_any_types(
    folder: Path, columns: dict[str, tuple[Any, bytes]], data: st.DataObject
) -> None:
    """Columns of types that nobody would choose, with whatever these bytes mean as one: dates of
    the year 30,000, text in no encoding."""
    arrays: dict[str, Any] = {"path": pa.array(["a.jpg", "b.jpg"])}
    for name, (kind, raw) in columns.items():
        buffer = pa.py_buffer(raw)
        if pa.types.is_string(kind) or pa.types.is_binary(kind):
            arrays[name] = pa.Array.from_buffers(
                kind, 2, [None, pa.array([0, 8, 16], pa.int32()).buffers()[1], buffer]
            )
        elif (
            pa.types.is_boolean(kind)
            or pa.types.is_nested(kind)
            or pa.types.is_dictionary(kind)
            or pa.types.is_null(kind)
        ):
            arrays[name] = pa.nulls(2, kind)
        elif pa.types.is_primitive(kind) or pa.types.is_decimal(kind):
            arrays[name] = pa.Array.from_buffers(kind, 2, [None, buffer])
        else:
            arrays[name] = pa.nulls(2, kind)
    try:
        pq.write_table(pa.table(arrays), folder / "t.parquet")
    except pa.ArrowException:
        return
    scanned(folder / "t.parquet")
    (folder / "t.parquet").write_bytes(data.draw(damaged((folder / "t.parquet").read_bytes())))
    scanned(folder / "t.parquet")


def test_one_long_text_said_ten_thousand_times_stays_one(folder: Path) -> None:
    """A dictionary of one megabyte in a file of one is ten gigabytes once each row has its own."""
    index = pa.array([0] * 10_000, pa.int32())
    table = pa.table({"path": pa.DictionaryArray.from_arrays(index, pa.array(["x" * (1 << 20)]))})
    pq.write_table(table, folder / "bomb.parquet")
    scanned(folder / "bomb.parquet")


@given(st.text(max_size=80) | st.tuples(names, numbers, numbers, numbers).map(" ".join))
@examples(60)
def test_a_line_of_denseuav(line: str) -> None:
    with bounded(Unreadable):
        parse_line(line)


@pytest.mark.parametrize(
    "line",
    [
        "a.jpg " * 50_000,
        "a.jpg E1 " * 30_000,
        "a.jpg" + " " * 100_000 + "x",
        "1.jpg" * 50_000 + " 1" * 50_000,
    ],
)
def test_a_long_line_of_denseuav_is_read_in_time(line: str) -> None:
    with bounded(Unreadable):
        parse_line(line)


@given(
    st.binary(max_size=200)
    | damaged(b"train/satellite/0001/H80.tif E120.387 N30.32 94.6\nb.jpg 30.1 120.2 80\n")
)
@examples(30)
def test_tables_of_denseuav_and_university1652(folder: Path, data: bytes) -> None:
    (folder / "Dense_GPS_train.txt").write_bytes(data)
    with bounded(InputError):
        read_gps_tables(str(folder))
    for name, head in (
        ("locations.csv", b"location,lat,lon\n"),
        ("poses.csv", b"path,location,altitude_m,heading_deg,pitch_deg\n"),
    ):
        (folder / name).write_bytes(head + data)
    with bounded(InputError):
        list(University1652().scan(str(folder)))
    (folder / "satellite_coordinates_range.csv").write_bytes(
        b"mapname,LT_lat_map,LT_lon_map,RB_lat_map,RB_lon_map\n" + data
    )
    with bounded(InputError):
        read_corners(str(folder))


def test_a_part_of_a_map_that_counts_to_a_trillion(folder: Path) -> None:
    (folder / "satellite_coordinates_range.csv").write_text(
        "mapname,LT_lat_map,LT_lon_map,RB_lat_map,RB_lon_map\n09,2,1,1,2\n"
    )
    (folder / "satellite09_999999-999999.tif").write_bytes(tiff())
    with bounded(InputError):
        maps, rejected = read_maps(str(folder), read_corners(str(folder))[0])
        assert not maps
        assert [one.reason for one in rejected] == ["incomplete map"]


def tiff() -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    Image.new("RGB", (16, 16)).save(stream, "TIFF")
    return stream.getvalue()


@given(twisted([PAIR, PAIR]), st.sampled_from(["pos", "pos_semipos"]))
@examples(80)
def test_pairs_of_gta_uav(folder: Path, value: Any, pairs: Any) -> None:
    (folder / "cross-area-drone2sate-train.json").write_text(json.dumps(value))
    with bounded(InputError):
        list(GtaUav(pairs=pairs).scan(str(folder)))


sql = values.filter(lambda value: not isinstance(value, list | dict)) | st.binary(max_size=16)


@given(
    st.lists(st.tuples(sql, sql, sql, sql), max_size=4),
    st.dictionaries(st.sampled_from(["format", "scheme", "x"]), sql),
    st.data(),
)
@examples(40)
def test_an_mbtiles(
    folder: Path, tiles: list[tuple[Any, ...]], metadata: dict[str, Any], data: st.DataObject
) -> None:
    path = folder / "t.mbtiles"
    path.unlink(missing_ok=True)
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE tiles (zoom_level, tile_column, tile_row, tile_data)")
        database.execute("CREATE TABLE metadata (name, value)")
        for table, rows in (
            ("tiles", [(3, 1, 1, b"\x89PNG" + bytes(20)), *tiles]),
            ("metadata", list(metadata.items())),
        ):
            for row in rows:
                try:
                    database.execute(
                        f"INSERT INTO {table} VALUES ({','.join('?' * len(row))})", row
                    )
                except (OverflowError, UnicodeEncodeError):
                    continue
        database.commit()
    read_tiles(path)
    path.write_bytes(data.draw(damaged(path.read_bytes(), head=200)))
    read_tiles(path)


def read_tiles(path: Path, seconds: float = 10) -> None:
    source = Xyz()
    with bounded(InputError, OSError, seconds=seconds):
        for item in source.scan(str(path)):
            if isinstance(item, ImageRecord):
                source.ending(item)
                source.read(item)


@pytest.mark.parametrize("view", [
    "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT 3 AS zoom_level, x AS "
    "tile_column, 1 AS tile_row, x'89' AS tile_data FROM n",
    "SELECT 3 AS zoom_level, 1 AS tile_column, 1 AS tile_row, zeroblob(900000000) AS tile_data",
    "SELECT 3 AS zoom_level, a.x AS tile_column, 1 AS tile_row, x'89' AS tile_data FROM t a, t b, t c, t d, t e, t f",
])  # fmt: skip
def test_a_view_without_end_is_given_up(
    folder: Path, view: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mbtiles, "QUERY_TIMEOUT_S", 0.5)
    path = folder / "view.mbtiles"
    path.unlink(missing_ok=True)
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE t (x)")
        database.executemany("INSERT INTO t VALUES (?)", [(x,) for x in range(1000)])
        database.execute(f"CREATE VIEW tiles AS {view}")
        database.commit()
    read_tiles(path)
