"""UAV-VisLoc: maps, their tiles and their parts."""

import pickle
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.core.errors import InputError
from pipeline.core.records import Rejection
from pipeline.sources.maps.tiles import parse_window
from tests.sources.visloc_miniature import (
    MAP_HWC,
    PHOTOS,
    miniature,
    pixels,
    scanned,
    split_map,
    tiff,
    tile,
    touch,
)


def test_visloc_photo_location_is_the_nearest_tile(tmp_path: Path) -> None:
    records, refused = scanned(miniature(tmp_path), tile())
    assert not refused
    assert [record.key for record in records if record.view == "drone"] == [
        "query-drone-01-0000-0000-01_0001",
        "query-drone-01-0000-0001-01_0002",
        "query-drone-01-0001-0002-01_0003",
    ]
    assert [record.location for record in records[:3]] == [
        "01-0000-0000",
        "01-0000-0001",
        "01-0001-0002",
    ]


def test_visloc_tile_pixels_centre_and_corners(tmp_path: Path) -> None:
    source = tile()
    records, _ = scanned(miniature(tmp_path), source)
    tiles = {record.location: record for record in records if record.view == "satellite"}
    assert sorted(tiles) == [f"01-000{row}-000{column}" for row in range(2) for column in range(3)]
    found = tiles["01-0001-0002"]
    assert (found.key, found.split, found.part) == (
        "gallery-satellite-01-0001-0002-x0000040-y0000020-w20-h20",
        "gallery",
        "x0000040-y0000020-w20-h20",
    )
    assert found.geotag is not None
    assert (found.geotag.lat, found.geotag.lon) == pytest.approx((30.01, 120.05))
    assert found.geotag.footprint is not None
    assert np.allclose(
        found.geotag.footprint, [(30.02, 120.04), (30.02, 120.06), (30.0, 120.06), (30.0, 120.04)]
    )
    for record in tiles.values():
        window = parse_window(record.part)
        expected = MAP_HWC[window.y : window.y + 20, window.x : window.x + 20]
        assert np.array_equal(pixels(source.read(record)), expected)
        assert source.ending(record) == "png"
    assert np.array_equal(pixels(source.read(found)), MAP_HWC[20:40, 40:60])


def test_visloc_overlapping_tiles_end_at_the_edge(tmp_path: Path) -> None:
    records, _ = scanned(miniature(tmp_path), tile(tile_pixels=30, overlap=0.5))
    windows = [record.part for record in records if record.part]
    assert windows == [f"x{x:07d}-y{y:07d}-w30-h30" for y in (0, 10) for x in (0, 15, 30)]


def test_visloc_map_smaller_than_a_tile_is_one_tile(tmp_path: Path) -> None:
    source = tile(tile_pixels=1024)
    records, _ = scanned(miniature(tmp_path), source)
    tiles = [record for record in records if record.part]
    assert [record.part for record in tiles] == ["x0000000-y0000000-w60-h40"]
    assert np.array_equal(pixels(source.read(tiles[0])), MAP_HWC)
    assert {record.location for record in records} == {"01-0000-0000"}


def test_visloc_jpeg_tiles_are_close_photos_keep_bytes(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    smooth = np.dstack([np.add.outer(np.arange(40), np.arange(60)).astype(np.uint8)] * 3)
    tiff(root / "01/satellite01.tif", smooth)
    source = tile(encoding="jpg")
    records, _ = scanned(root, source)
    data = source.read(records[-1])
    assert data[:3] == b"\xff\xd8\xff"
    assert np.abs(pixels(data).astype(int) - smooth[20:40, 40:60]).max() <= 4
    assert (source.ending(records[-1]), source.ending(records[0])) == ("jpg", "jpg")
    assert source.read(records[0]) == b"never opened"


@pytest.mark.parametrize("bands", [1, 4])
def test_visloc_grey_and_transparent_maps_are_read(tmp_path: Path, bands: int) -> None:
    root = miniature(tmp_path)
    four = np.dstack([MAP_HWC, np.full((40, 60), 255, np.uint8)])
    tiff(root / "01/satellite01.tif", four[:, :, :bands])
    records, _ = scanned(root, tile())
    expected = MAP_HWC[20:40, 40:60]
    if bands == 1:
        expected = np.repeat(expected[:, :, :1], 3, axis=2)
    assert np.array_equal(pixels(tile().read(records[-1])), expected)


def test_visloc_map_without_georeference_gives_no_warning(
    tmp_path: Path,
) -> None:
    root = miniature(tmp_path)
    Image.fromarray(MAP_HWC).save(root / "01/satellite01.tif")
    records, refused = scanned(root, tile())
    assert not refused
    assert np.array_equal(pixels(tile().read(records[-1])), MAP_HWC[20:40, 40:60])


def test_visloc_16_bit_map_is_stretched_as_a_whole(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    ramp = np.dstack([np.tile(np.arange(60, dtype=np.uint16) * 100 + 1000, (40, 1))] * 3)
    tiff(root / "01/satellite01.tif", ramp)
    records, _ = scanned(root, tile())
    tiles = [pixels(tile().read(record)) for record in records if record.part]
    assert tiles[0][0, 0, 0] == 0
    assert tiles[2][0, -1, 0] == 255
    assert np.array_equal(tiles[0], tiles[3])  # one row below


def test_visloc_train_flights_keep_only_shown_tiles(tmp_path: Path) -> None:
    records, refused = scanned(miniature(tmp_path), tile(train_flights=("01",)))
    assert not refused
    assert {record.split for record in records} == {"train"}
    assert [record.location for record in records if record.part] == [
        "01-0000-0000",
        "01-0000-0001",
        "01-0001-0002",
    ]
    with pytest.raises(InputError, match="--train-flights names 1, expected some of 01"):
        scanned(tmp_path, tile(train_flights=("1",)))


def test_visloc_map_parts_share_the_corners(tmp_path: Path) -> None:
    source = tile(tile_pixels=100)
    records, refused = scanned(split_map(tmp_path), source)
    assert not refused
    tiles = {record.location: record for record in records if record.part}
    assert list(tiles) == [f"01_0{row}-0{column}-0000-0000" for row in (1, 2) for column in (1, 2)]
    last = tiles["01_02-02-0000-0000"].geotag
    assert last is not None
    assert (last.lat, last.lon) == pytest.approx((30.012, 120.042))
    assert np.array_equal(pixels(source.read(tiles["01_02-01-0000-0000"])), MAP_HWC[16:40, 0:24])


def test_visloc_map_with_missing_part_is_refused(tmp_path: Path) -> None:
    (split_map(tmp_path) / "01/satellite01_01-02.tif").unlink()
    with pytest.raises(InputError, match="no images below"):
        list(tile().scan(str(tmp_path)))
    refused: list[Rejection] = []
    with pytest.raises(InputError):
        refused.extend(item for item in tile().scan(str(tmp_path)) if isinstance(item, Rejection))
    assert [r.reason for r in refused] == ["incomplete map"] * 3 + ["off the map"] * 3


def test_visloc_photo_off_the_map_is_refused(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    (root / "01/01.csv").write_text(f"{PHOTOS}1,01_0001.JPG,,31,120.009,466,,,,\n")
    _, refused = scanned(root, tile())
    assert [(Path(r.path).name, r.reason) for r in refused] == [
        ("01_0001.JPG", "off the map"),
        ("01_0002.JPG", "no position"),
        ("01_0003.JPG", "no position"),
    ]


def test_visloc_unreadable_and_unplaced_maps_are_refused(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    touch(root / "02/drone/02_0001.JPG")
    touch(root / "02/satellite02.tif")
    touch(root / "02/satellite_extra.tif")
    (root / "02/02.csv").write_text(f"{PHOTOS}1,02_0001.JPG,,30.031,120.009,466,,,,\n")
    with (root / "satellite_ coordinates_range.csv").open("a") as table:
        table.write(
            "02.tif,30.04,120,30.0,120.06,as the example spells it\n"
            "03.tif,30,120,31,121,upside down\n"
        )
    records, refused = scanned(root, tile())
    assert len(records) == 9
    assert sorted((Path(r.path).name, r.reason) for r in refused) == [
        ("02_0001.JPG", "off the map"),
        ("satellite02.tif", "unreadable map"),
        ("satellite_ coordinates_range.csv", "unreadable tag"),
        ("satellite_extra.tif", "map without corners"),
    ]


def test_visloc_is_pickled_and_read_in_threads(
    tmp_path: Path,
) -> None:
    source = tile()
    records, _ = scanned(miniature(tmp_path), source)
    tiles = [record for record in records if record.part] * 20
    sent = pickle.loads(pickle.dumps(source))
    with ThreadPoolExecutor(4) as pool:
        for record, data in zip(tiles, pool.map(sent.read, tiles), strict=True):
            window = parse_window(record.part)
            expected = MAP_HWC[
                window.y : window.y + window.height, window.x : window.x + window.width
            ]
            assert np.array_equal(pixels(data), expected)
