"""Tables of images: formats agree, bad rows are refused by number, bad files by a sentence."""

from datetime import UTC, datetime
from pathlib import Path

import fsspec
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import GeoTag, ImageRecord, Rejection, Split, View
from pipeline.sources import source_class
from pipeline.sources.table import Table
from tests.sources.table_files import images, only, scan


def test_csv_row_becomes_a_record(tmp_path: Path) -> None:
    images(tmp_path, "flug/été 1.JPG")
    text = (
        "path,view,split,location,lat,lon,altitude_m,heading_deg,pitch_deg,taken_at,operator\n"
        "flug/été 1.JPG,Satellite,gallery,0001,-33.5,-70.75,100,-90,-45,"
        "2024-05-01T12:34:56+02:00,me\n"
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


def test_csv_path_alone_is_enough(tmp_path: Path) -> None:
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
def test_csv_delimiters_bom_aliases_and_case(tmp_path: Path, delimiter: str, encoding: str) -> None:
    images(tmp_path, "ö 1.jpg")
    text = '"Path",Latitude,LNG\r\n\r\n"ö 1.jpg",47.5,8.25\r\n'.replace(",", delimiter)
    tag = only(scan(tmp_path / "t.csv", text.encode(encoding))).geotag
    assert tag == GeoTag(lat=47.5, lon=8.25)


def test_csv_decimal_comma_with_other_delimiters(tmp_path: Path) -> None:
    images(tmp_path, "1.jpg")
    assert only(scan(tmp_path / "t.csv", "path;lat;lon\n1.jpg;47,5;8,25\n")).geotag == GeoTag(
        lat=47.5, lon=8.25
    )
    [refused] = scan(tmp_path / "t.csv", 'path,lat,lon\n1.jpg,"47,5",8\n')
    assert isinstance(refused, Rejection)
    assert refused.found == "row 1: lat 47,5"


def test_csv_bad_rows_are_refused_by_number(tmp_path: Path) -> None:
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


def test_table_zero_zero_is_no_position(tmp_path: Path) -> None:
    images(tmp_path, "1.jpg")
    found = scan(tmp_path / "t.csv", "path,lat,lon\n1.jpg,,\n1.jpg,nan,NaN\n1.jpg,0,0.0\n")
    assert [record.geotag for record in found if isinstance(record, ImageRecord)] == [None] * 3


def test_table_paths_may_be_absolute_or_uris(tmp_path: Path) -> None:
    images(tmp_path, "1.jpg")
    text = (
        f"path\n{tmp_path}/1.jpg\nfile://{tmp_path}/1.jpg\nmemory://bucket/2.jpg\n"
        f"file://{tmp_path}/3.jpg\nnul\0.jpg\n"
    )
    (tmp_path / "sub").mkdir()
    found = scan(tmp_path / "sub/t.csv", text)
    assert [f.bytes if isinstance(f, ImageRecord) else f.reason for f in found] == [
        5,
        5,
        None,
        "no such file",
        "no such file",
    ]


def test_table_on_object_store_names_images_beside_it() -> None:
    fsspec.filesystem("memory").rm("/", recursive=True)
    storage.write_bytes("memory://bucket/set/t.csv", b"path\na/1.jpg\n")
    record = only(list(Table().scan("memory://bucket/set/t.csv")))
    assert (record.path, record.bytes) == ("memory://bucket/set/a/1.jpg", None)


def test_table_bare_file_name_is_in_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    images(tmp_path, "1.jpg")
    (tmp_path / "t.csv").write_text("path\n1.jpg\n")
    monkeypatch.chdir(tmp_path)
    assert only(list(Table().scan("t.csv"))).bytes == 5


def test_parquet_types_are_read(tmp_path: Path) -> None:
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


def test_table_pandas_missing_values_are_missing(tmp_path: Path) -> None:
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


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        (
            "t.csv",
            b"file,lat,lon\n1.jpg,1,2\n",
            r"no column path but file, lat, lon; expected path and any of view",
        ),
        ("t.csv", b"path,lat\n1.jpg,1\n", "no column lon but path, lat"),
        ("t.csv", b"path,lat,latitude,lon\n1.jpg,1,1,1\n", "two columns for lat"),
        (
            "t.csv",
            "path\nübung.jpg\n".encode("latin-1"),
            r"is not UTF-8 \(byte 0xfc\).*save it again as UTF-8",
        ),
        ("t.csv", "path\n1.jpg\n".encode("utf-16"), "is not UTF-8, it is UTF-16.*iconv -f utf16"),
        ("t.csv", "path\nü.jpg\n".encode("utf-16-be"), "is not UTF-8, it is UTF-16"),
        ("t.csv", b"", "no column path but none"),
        ("t.csv", b"path,lat,lon\n", "has no rows"),
        ("t.csv", b"path\n" + b"x" * 200_000, "cannot be read as CSV"),
        ("t.parquet", b"PAR1 not really", "cannot be read as Parquet"),
        ("t.geojson", b"{", "cannot be read as JSON"),
        ("t.geojson", b"[" * 200_000, "cannot be read as JSON"),
        ("t.geojson", b'{"type": "Feature"}', "holds no FeatureCollection"),
        ("t.geojson", b'{"type": "FeatureCollection", "features": []}', "has no rows"),
        (
            "t.geojson",
            b'{"type": "FeatureCollection", "features": [{"properties": {"file": "1.jpg"}}]}',
            "no column path",
        ),
        (
            "t.geojson",
            b'{"type": "FeatureCollection", "features": [], "crs": {"properties": '
            b'{"name": "EPSG:2056"}}}',
            "expected longitude and latitude, WGS84; reproject it",
        ),
        ("t.xlsx", b"PK", r"no table by its name, expected .csv, .tsv, .parquet, .geojson, .json"),
    ],
)
def test_table_unusable_file_is_refused(
    tmp_path: Path, name: str, text: bytes, sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        scan(tmp_path / name, text)


def test_table_missing_file_and_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no file .*t.csv; expected a table of images"):
        scan(tmp_path / "t.csv")
    with pytest.raises(InputError, match="is a folder, expected a table of images"):
        scan(tmp_path)


def test_csv_words_for_missing_values_are_empty_cells(tmp_path: Path) -> None:
    images(tmp_path, *(f"{number}.jpg" for number in range(12)))
    words = ["NA", "N/A", "null", "NULL", "None", "#N/A", "<NA>", "nil", "NaT", "-nan", "", " "]
    rows = [f"{number}.jpg,{word},{word},{word},{word}" for number, word in enumerate(words)]
    text = "\n".join(["path,location,lat,lon,altitude_m", *rows, ",,,,", " , ,,,", ""])
    found = scan(tmp_path / "t.csv", text)
    assert len(found) == 12
    for number, record in enumerate(found):
        assert isinstance(record, ImageRecord), record
        assert (record.location, record.geotag) == (str(number), None)


@pytest.mark.parametrize(
    "text",
    [
        "path,lat,lon,\n1.jpg,47.5,8.25,\n",
        "path,lat,lon,,\n1.jpg,47.5,8.25\n",
        "path,lat,lon\n1.jpg,47.5,8.25,,\n",
        "sep=;\npath;lat;lon\n1.jpg;47,5;8,25\n",
        '"sep=,"\r\npath,lat,lon\r\n1.jpg,47.5,8.25\r\n',
        "sep=\t\npath\tlat\tlon\n1.jpg\t47.5\t8.25\n",
    ],
)
def test_csv_as_spreadsheets_write_it(tmp_path: Path, text: str) -> None:
    images(tmp_path, "1.jpg")
    assert only(scan(tmp_path / "t.csv", text)).geotag == GeoTag(lat=47.5, lon=8.25)


def test_csv_rows_with_other_separators_are_refused(tmp_path: Path) -> None:
    images(tmp_path, "1.jpg", "2.jpg")
    found = scan(tmp_path / "t.csv", "path,lat,lon\n1.jpg,47.5,8.25\n2.jpg,47.5,8.25,\n")
    assert isinstance(found[1], Rejection)
    assert found[1].reason == "wrong number of cells"


def test_table_whole_numbers_that_became_floats_are_labels(tmp_path: Path) -> None:
    images(tmp_path, "1.jpg", "2.jpg", "3.jpg")
    frame = pd.DataFrame({"path": ["1.jpg", "2.jpg", "3.jpg"], "location": [12, None, 1.5]})
    frame.to_csv(tmp_path / "t.csv", index=False)
    frame.to_parquet(tmp_path / "t.parquet")
    for name in ("t.csv", "t.parquet"):
        found = scan(tmp_path / name)
        assert [one.location for one in found if isinstance(one, ImageRecord)] == ["12", "2", "1.5"]
