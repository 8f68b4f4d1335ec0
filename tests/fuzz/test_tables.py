"""CSV, Parquet and GeoJSON from anywhere: rows, rejected rows, or a sentence why there are none."""

import csv
import io
import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.errors import InputError
from pipeline.core.records import ImageRecord, Rejection
from pipeline.sources.table import Table
from pipeline.sources.text_tables import read_rows
from tests.fuzz.bounds import bounded, examples
from tests.fuzz.hostile import damaged, names, numbers, twisted

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
def test_csv_is_read_or_rejected(
    folder: Path, rows: list[list[str]], delimiter: str, data: st.DataObject
) -> None:
    text = io.StringIO()
    writer = csv.writer(text, delimiter=delimiter, escapechar="\\")
    writer.writerows([COLUMNS, ROW, *rows])
    encoding = data.draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "latin-1"]))
    content = text.getvalue().encode(
        encoding, "surrogatepass" if encoding.startswith("utf") else "replace"
    )
    (folder / "t.csv").write_bytes(
        data.draw(damaged(content)) if data.draw(st.booleans()) else content
    )
    scanned(folder / "t.csv")
    with bounded(InputError):
        list(read_rows(str(folder / "t.csv"), ("path", "lat")))


@given(twisted(GEOJSON), st.data())
@examples(80)
def test_geojson_is_read_or_rejected(folder: Path, value: Any, data: st.DataObject) -> None:
    content = json.dumps(value).encode()
    (folder / "t.geojson").write_bytes(
        data.draw(damaged(content)) if data.draw(st.booleans()) else content
    )
    scanned(folder / "t.geojson")


def test_deeply_nested_geojson_is_rejected(folder: Path) -> None:
    for depth in (900, 960, 980, 990, 100_000):
        deep = "[" * depth + "]" * depth
        (folder / "t.geojson").write_text(
            f'{{"type": "FeatureCollection", "features": [{{"properties": {{"path": {deep}}}, '
            f'"geometry": {deep}}}]}}'
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
def test_parquet_of_any_types_is_read_or_rejected(
    folder: Path, columns: dict[str, tuple[Any, bytes]], data: st.DataObject
) -> None:
    """Columns of unusual types with arbitrary bytes: dates of the year 30,000, invalid UTF-8."""
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


def test_repeated_long_dictionary_value_stays_in_bounds(folder: Path) -> None:
    """A dictionary of one megabyte in a file of one is ten gigabytes once each row has its own."""
    index = pa.array([0] * 10_000, pa.int32())
    table = pa.table({"path": pa.DictionaryArray.from_arrays(index, pa.array(["x" * (1 << 20)]))})
    pq.write_table(table, folder / "bomb.parquet")
    scanned(folder / "bomb.parquet")
