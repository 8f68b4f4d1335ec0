"""Tiles of web maps: each lies where the grid says, whichever way its rows are counted and whatever
it is stored in.
"""

import io
import math
import sqlite3
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from pipeline.core.errors import InputError
from pipeline.core.records import ImageRecord, Rejection
from pipeline.sources.maps.web_mercator import is_on_grid, tile_geotag, tile_to_degrees
from pipeline.sources.xyz import Xyz

EDGE = 85.0511287798066  # degrees: atan(sinh(pi)), where the square map ends


def tile(number: int = 0, kind: str = "PNG") -> bytes:
    stream = io.BytesIO()
    Image.fromarray(np.full((8, 8, 3), number, np.uint8)).save(stream, kind)
    return stream.getvalue()


def folder(root: Path, *names: str) -> str:
    for number, name in enumerate(names):
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        ending = name.rsplit(".", 1)[-1].lower()
        path.write_bytes(tile(number, {"png": "PNG", "webp": "WEBP"}.get(ending, "JPEG")))
    return str(root)


def mbtiles(path: Path, tiles: dict[tuple[int, int, int], bytes], **metadata: str) -> str:
    """An MBTiles file of (zoom, column, row) -> bytes, rows as they are to stand in the file."""
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE metadata (name text, value text)")
        database.execute(
            "CREATE TABLE tiles (zoom_level integer, tile_column integer, tile_row integer, tile_data blob)"
        )
        database.executemany("INSERT INTO metadata VALUES (?, ?)", list(metadata.items()))
        database.executemany(
            "INSERT INTO tiles VALUES (?, ?, ?, ?)",
            [(*where, data) for where, data in tiles.items()],
        )
    return str(path)


def records(root: str, **settings: Any) -> dict[str, ImageRecord]:
    """By location; fails where anything is refused."""
    found = list(Xyz(**settings).scan(root))
    assert not [one for one in found if isinstance(one, Rejection)]
    return {record.location: record for record in found if isinstance(record, ImageRecord)}


# The grid


def test_the_whole_world_is_the_tile_of_zoom_0() -> None:
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
def test_the_four_tiles_of_zoom_1(x: int, y: int, lat: int, lon: int) -> None:
    tag = tile_geotag(1, x, y)
    assert tag.lon == lon
    # The middle on the map, a quarter of the way round: atan(sinh(pi / 2)); the middle in degrees
    # would be 42.5.
    assert tag.lat == pytest.approx(lat * 66.51326044311186, abs=1e-12)
    assert tag.footprint is not None
    assert sorted({abs(place[0]) for place in tag.footprint}) == pytest.approx([0, EDGE])


def test_a_tile_worked_by_hand_over_the_brandenburg_gate() -> None:
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
def test_places_are_those_of_web_mercator(zoom: int, x: float, y: float) -> None:
    half = math.pi * 6378137
    to_wgs84 = pyproj.Transformer.from_crs("EPSG:3857", "EPSG:4326", always_xy=True)
    lon, lat = to_wgs84.transform((2 * x - 1) * half, (1 - 2 * y) * half)
    said = tile_to_degrees(zoom, x * 2**zoom, y * 2**zoom)
    assert said[0] == pytest.approx(lat, abs=1e-9)
    assert (said[1] - lon) % 360 == pytest.approx(0, abs=1e-9) or abs(
        (said[1] - lon) % 360 - 360
    ) < 1e-9


def test_numbers_beyond_the_grid_are_seen() -> None:
    assert is_on_grid(3, 7, 0)
    assert not is_on_grid(3, 8, 0)
    assert not is_on_grid(3, 0, -1)


# Folders


def test_a_folders_tiles_are_found_with_their_places(tmp_path: Path) -> None:
    root = folder(
        tmp_path,
        "3/4/2.png",
        "3/5/2.JPG",
        "3/5/3.jpeg",
        "3/6/2.webp",
        "metadata.json",
        "leaflet.html",
    )
    found = records(root)
    assert list(found) == ["3-4-2", "3-5-2", "3-5-3", "3-6-2"]
    for location, record in found.items():
        _, x, y = map(int, location.split("-"))
        assert record.geotag == tile_geotag(3, x, y)
        assert record.bytes == len(Xyz().read(record))
    assert [Xyz().ending(record) for record in found.values()] == ["png", "jpg", "jpg", "webp"]
    assert Xyz().read(found["3-4-2"]) == (tmp_path / "3/4/2.png").read_bytes()
    assert (found["3-4-2"].view, found["3-4-2"].split) == ("satellite", "gallery")


def test_rows_counted_from_the_south_are_turned_round(tmp_path: Path) -> None:
    root = folder(tmp_path, "2/1/0.png")
    assert list(records(root, tms=True)) == ["2-1-3"]
    assert records(root, tms=True)["2-1-3"].geotag == tile_geotag(2, 1, 3)


def test_of_many_zooms_the_deepest_is_taken_and_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = folder(tmp_path, "9/1/1.png", "10/2/2.png", "10/2/3.png")
    assert list(records(root)) == ["10-2-2", "10-2-3"]
    assert "taking zoom 10, the deepest; --zoom takes another of 9" in capsys.readouterr().err
    assert list(records(root, zoom=9)) == ["9-1-1"]
    assert capsys.readouterr().err == ""
    with pytest.raises(InputError, match=r"no tiles of zoom 8 .* it holds zooms 9, 10"):
        records(root, zoom=8)


def test_wrong_folders_and_numbers_are_refused_with_reasons(tmp_path: Path) -> None:
    root = folder(
        tmp_path, "3/4/2.png", "3/8/2.png", "3/4/9.png", "3/west/2.png", "stray.png", "40/1/1.png"
    )
    (tmp_path / "3/4/2.png.aux.xml").write_text("<x/>")
    found = list(Xyz().scan(root))
    reasons = {
        Path(r.path).relative_to(root).as_posix(): r.reason
        for r in found
        if isinstance(r, Rejection)
    }
    assert reasons == {
        "3/8/2.png": "outside of the map",
        "3/4/9.png": "outside of the map",
        "3/west/2.png": "wrong folder",
        "stray.png": "wrong folder",
        "40/1/1.png": "wrong folder",
    }
    assert [r.found for r in found if isinstance(r, Rejection) and r.path.endswith("8/2.png")] == [
        "8, 2; zoom 3 has 0 to 7"
    ]


def test_what_is_no_tile_set_is_told_with_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no folder and no \.mbtiles file"):
        records(str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match="no tiles in"):
        records(folder(tmp_path, "a/b.png"))
    with pytest.raises(InputError, match="vector tiles"):
        records(folder(tmp_path / "vector", "3/4/2.pbf"))
    with pytest.raises(InputError, match="--zoom is 31"):
        Xyz(zoom=31)


# MBTiles


def test_an_mbtiles_file_is_read_with_its_rows_turned_round(tmp_path: Path) -> None:
    stored = {
        (3, 4, 0): tile(1),
        (3, 4, 1): tile(2, "JPEG"),
        (3, 5, 0): tile(3, "WEBP"),
        (2, 0, 0): tile(9),
    }
    root = mbtiles(tmp_path / "town #1?.mbtiles", stored, format="png")
    found = records(root)
    assert sorted(found) == ["3-4-6", "3-4-7", "3-5-7"]
    assert found["3-4-7"].geotag == tile_geotag(3, 4, 7)
    assert [Xyz().read(found[name]) for name in ("3-4-7", "3-4-6", "3-5-7")] == [
        tile(1),
        tile(2, "JPEG"),
        tile(3, "WEBP"),
    ]
    assert [Xyz().ending(found[name]) for name in ("3-4-7", "3-4-6", "3-5-7")] == [
        "png",
        "jpg",
        "webp",
    ]
    assert len({record.key for record in found.values()}) == 3
    assert list(records(root, zoom=2)) == ["2-0-3"]


def test_a_file_that_says_so_counts_rows_from_the_north(tmp_path: Path) -> None:
    found = records(mbtiles(tmp_path / "a.mbtiles", {(3, 4, 0): tile(1)}, scheme="xyz"))
    assert list(found) == ["3-4-0"]
    assert Xyz().read(found["3-4-0"]) == tile(1)


def test_a_folder_and_a_file_of_the_same_tiles_say_the_same(tmp_path: Path) -> None:
    by_folder = records(folder(tmp_path / "xyz", "4/3/2.png", "4/3/3.png"))
    by_file = records(mbtiles(tmp_path / "a.mbtiles", {(4, 3, 13): tile(0), (4, 3, 12): tile(1)}))
    assert {name: record.geotag for name, record in by_folder.items()} == {
        name: record.geotag for name, record in by_file.items()
    }
    assert [Xyz().read(by_folder[name]) for name in by_folder] == [
        Xyz().read(by_file[name]) for name in by_folder
    ]


def test_threads_read_the_same_bytes_and_the_file_is_never_written(tmp_path: Path) -> None:
    root = mbtiles(
        tmp_path / "a.mbtiles", {(8, x, y): tile(x * 16 + y) for x in range(8) for y in range(8)}
    )
    before = Path(root).read_bytes()
    found = list(records(root).values())
    one_by_one = [Xyz().read(record) for record in found]
    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(Xyz().read, found * 4)) == one_by_one * 4
    assert Path(root).read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["a.mbtiles"]


def test_tiles_that_are_no_images_or_lie_outside_are_refused(tmp_path: Path) -> None:
    stored = {
        (3, 4, 0): tile(1),
        (3, 4, 1): b"hello",
        (3, 4, 2): b"",
        (3, 9, 0): tile(2),
        (3, 0, -1): tile(3),
    }
    found = list(Xyz().scan(mbtiles(tmp_path / "a.mbtiles", stored)))
    reasons = {r.path.rpartition("#")[2]: r.reason for r in found if isinstance(r, Rejection)}
    assert reasons == {
        "3-4-6": "not an image",
        "3-4-5": "not an image",
        "3-9-7": "outside of the map",
        "3-0-8": "outside of the map",
    }
    assert len(found) == 5


def test_vector_tiles_and_damaged_files_are_told_with_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"vector tiles \(pbf\)"):
        records(mbtiles(tmp_path / "said.mbtiles", {(3, 4, 0): b"\x1a"}, format="pbf"))
    with pytest.raises(InputError, match=r"vector tiles \(gzip\)"):
        records(mbtiles(tmp_path / "unsaid.mbtiles", {(3, 4, 0): b"\x1f\x8b\x08"}))
    with pytest.raises(InputError, match="no tiles in"):
        records(mbtiles(tmp_path / "empty.mbtiles", {}))
    (tmp_path / "text.mbtiles").write_text(
        "no database at all, but long enough to be taken for one" * 20
    )
    with pytest.raises(InputError, match="cannot be read as MBTiles"):
        records(str(tmp_path / "text.mbtiles"))
    with closing(sqlite3.connect(tmp_path / "other.mbtiles")) as database, database:
        database.execute("CREATE TABLE t (a)")
    with pytest.raises(InputError, match="no such table: tiles"):
        records(str(tmp_path / "other.mbtiles"))


def test_a_tile_that_went_away_is_an_unreadable_file(tmp_path: Path) -> None:
    root = mbtiles(tmp_path / "a.mbtiles", {(3, 4, 0): tile(1)})
    [record] = records(root).values()
    with closing(sqlite3.connect(root)) as database, database:
        database.execute("DELETE FROM tiles")
    with pytest.raises(OSError, match="no tile 3/4/0"):
        Xyz().read(record)
    Path(root).unlink()
    with pytest.raises(OSError, match="cannot be read as MBTiles"):
        Xyz().read(record)
    assert not Path(root).exists()
