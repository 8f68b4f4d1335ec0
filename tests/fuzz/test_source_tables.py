"""Tables of particular sources: rows, rejections, or a sentence why there are none."""

import io
import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.errors import InputError
from pipeline.core.records import ImageRecord
from pipeline.sources.denseuav import parse_line, read_gps_tables
from pipeline.sources.gta_uav import GtaUav
from pipeline.sources.maps import mbtiles
from pipeline.sources.text_tables import Unreadable
from pipeline.sources.university1652 import University1652
from pipeline.sources.visloc_maps import read_corners, read_maps
from pipeline.sources.xyz import Xyz
from tests.fuzz.bounds import bounded, examples
from tests.fuzz.hostile import damaged, names, numbers, twisted, values

PAIR = {
    "drone_img_dir": "drone/images",
    "drone_img_name": "a.png",
    "pair_pos_sate_img_list": ["t.png", "u.png"],
    "pair_pos_sate_weight_list": [0.5, 0.25],
    "pair_pos_semipos_sate_img_list": ["t.png"],
    "pair_pos_semipos_sate_weight_list": [0.5],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("tables")
    (found / "a.jpg").write_bytes(b"x")
    return found


@given(st.text(max_size=80) | st.tuples(names, numbers, numbers, numbers).map(" ".join))
@examples(60)
def test_denseuav_line_is_read_or_rejected(line: str) -> None:
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
def test_long_denseuav_line_is_read_in_time(line: str) -> None:
    with bounded(Unreadable):
        parse_line(line)


@given(
    st.binary(max_size=200)
    | damaged(b"train/satellite/0001/H80.tif E120.387 N30.32 94.6\nb.jpg 30.1 120.2 80\n")
)
@examples(30)
def test_damaged_source_tables_are_read_or_rejected(folder: Path, data: bytes) -> None:
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


def test_map_part_with_a_huge_number_is_rejected(folder: Path) -> None:
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
def test_gta_uav_pairs_are_read_or_rejected(folder: Path, value: Any, pairs: Any) -> None:
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
def test_mbtiles_is_read_or_rejected(
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
    "SELECT 3 AS zoom_level, a.x AS tile_column, 1 AS tile_row, x'89' AS tile_data FROM t a, t b, "
    "t c, t d, t e, t f",
])  # fmt: skip
def test_endless_mbtiles_view_is_stopped(
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
