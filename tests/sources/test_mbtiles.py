"""MBTiles files: rows, formats, damage, threads."""

import sqlite3
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from pipeline.core.errors import InputError
from pipeline.core.records import Rejection
from pipeline.sources.maps.web_mercator import tile_geotag
from pipeline.sources.xyz import Xyz
from tests.sources.tile_sets import mbtiles, records, tile


def test_mbtiles_rows_are_flipped(tmp_path: Path) -> None:
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


def test_mbtiles_scheme_xyz_counts_from_the_north(tmp_path: Path) -> None:
    found = records(mbtiles(tmp_path / "a.mbtiles", {(3, 4, 0): tile(1)}, scheme="xyz"))
    assert list(found) == ["3-4-0"]
    assert Xyz().read(found["3-4-0"]) == tile(1)


def test_mbtiles_read_in_threads_never_writes(tmp_path: Path) -> None:
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


def test_mbtiles_non_images_and_off_grid_tiles_are_refused(tmp_path: Path) -> None:
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


def test_mbtiles_vector_and_damaged_files_are_refused(tmp_path: Path) -> None:
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


def test_mbtiles_removed_tile_is_an_unreadable_file(tmp_path: Path) -> None:
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


def test_mbtiles_numbers_may_be_floats_or_text(tmp_path: Path) -> None:
    kinds: list[Any] = [float, str, "{}.0".format]
    for number, kind in enumerate(kinds):
        stored: dict[tuple[Any, Any, Any], bytes] = {
            (kind(3), kind(4), kind(row)): tile(row) for row in (0, 1)
        }
        root = mbtiles(tmp_path / f"{number}.mbtiles", stored, types=False)
        by_location = records(root)
        assert sorted(by_location) == ["3-4-6", "3-4-7"]
        assert Xyz().read(by_location["3-4-6"]) == tile(1)
        assert Xyz().ending(by_location["3-4-6"]) == "png"


def test_mbtiles_numbers_that_are_not_whole_are_refused(tmp_path: Path) -> None:
    stored: dict[tuple[Any, Any, Any], bytes] = {
        (3, 4, 0): tile(),
        (3, 4.5, 0): tile(),
        (3, "west", 0): tile(),
        ("deep", 1, 1): tile(),
        (99, 1, 1): tile(),
    }
    found = list(Xyz().scan(mbtiles(tmp_path / "a.mbtiles", stored, types=False)))
    refusals = sorted(one.found for one in found if isinstance(one, Rejection))
    assert refusals == [
        "1 tiles of zoom 'deep', expected 0 to 30",
        "1 tiles of zoom 99, expected 0 to 30",
        "column 'west', row 0",
        "column 4.5, row 0",
    ]
