"""UAV-VisLoc: tiles are the map's own pixels at the right places, and photos are labelled by the
nearest of them.
"""

import io
import pickle
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import rasterio
from PIL import Image

from pipeline.core.errors import InputError
from pipeline.core.records import GeoTag, ImageRecord, Rejection
from pipeline.sources.maps.tiles import parse_window
from pipeline.sources.visloc import VisLoc

RANGES = "mapname,LT_lat_map,LT_lon_map,RB_lat_map,RB_lon_map,region\n"
PHOTOS = "num,filename,date,lat,lon,height,Omega,Kappa,Phi1,Phi2\n"
MAP_HWC = np.random.default_rng(1).integers(0, 255, (40, 60, 3), dtype=np.uint8)


def touch(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"never opened")


def tiff(path: Path, pixels_HWC: npt.NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width, bands = pixels_HWC.shape
    where = rasterio.Affine(
        1 / width, 0, 0, 0, -1 / height, 1
    )  # not where the table says: the table counts
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=width,
        height=height,
        count=bands,
        dtype=pixels_HWC.dtype,
        transform=where,
    ) as raster:
        raster.write(pixels_HWC.transpose(2, 0, 1))


def miniature(root: Path) -> Path:
    """One flight over a map of 60 x 40 pixels of 0.001 degrees, from 30.04 N 120 E: 2 rows of 3
    tiles of 20 pixels.
    """
    tiff(root / "01/satellite01.tif", MAP_HWC)
    (root / "satellite_ coordinates_range.csv").write_text(
        f"{RANGES}satellite01.tif,30.04,120,30.0,120.06,Somewhere-1\n"
    )
    for number in range(1, 4):
        touch(root / f"01/drone/01_000{number}.JPG")
    (root / "01/01.csv").write_text(
        f"{PHOTOS}1,01_0001.JPG,2018-09-26T10:05:11,30.031,120.009,466.5,1,2,-90,80\n"
        "2,01_0002.JPG,2018/09/26 10:05:15,30.0301,120.0311,470,1,2,95.5,80\n"
        "3,01_0003.JPG,,30.0,120.06,470,1,2,,\n"
    )
    return root


def scanned(root: Path | str, source: VisLoc) -> tuple[list[ImageRecord], list[Rejection]]:
    found = list(source.scan(str(root)))
    return [f for f in found if isinstance(f, ImageRecord)], [
        f for f in found if isinstance(f, Rejection)
    ]


def tile(**changes: Any) -> VisLoc:
    settings: dict[str, Any] = {"tile_pixels": 20, "encoding": "png"} | changes
    return VisLoc(**settings)


def pixels(data: bytes) -> npt.NDArray[np.uint8]:
    return np.asarray(Image.open(io.BytesIO(data)))


def test_photos_lie_in_the_tile_whose_centre_is_nearest(tmp_path: Path) -> None:
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


def test_photos_have_position_height_heading_and_time_from_the_flights_table(
    tmp_path: Path,
) -> None:
    records, _ = scanned(miniature(tmp_path), tile())
    assert records[0].geotag == GeoTag(lat=30.031, lon=120.009, altitude_m=466.5, heading_deg=270)
    assert records[1].geotag == GeoTag(lat=30.0301, lon=120.0311, altitude_m=470, heading_deg=95.5)
    assert records[2].geotag == GeoTag(lat=30.0, lon=120.06, altitude_m=470)
    assert [record.taken_at for record in records[:3]] == [
        "2018-09-26T10:05:11",
        "2018-09-26T10:05:15",
        None,
    ]


def test_a_tile_is_the_maps_pixels_and_knows_its_centre_and_corners(tmp_path: Path) -> None:
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


def test_overlapping_tiles_cover_the_edge_with_whole_tiles(tmp_path: Path) -> None:
    records, _ = scanned(miniature(tmp_path), tile(tile_pixels=30, overlap=0.5))
    windows = [record.part for record in records if record.part]
    assert windows == [f"x{x:07d}-y{y:07d}-w30-h30" for y in (0, 10) for x in (0, 15, 30)]


def test_a_map_smaller_than_a_tile_is_one_tile(tmp_path: Path) -> None:
    source = tile(tile_pixels=1024)
    records, _ = scanned(miniature(tmp_path), source)
    tiles = [record for record in records if record.part]
    assert [record.part for record in tiles] == ["x0000000-y0000000-w60-h40"]
    assert np.array_equal(pixels(source.read(tiles[0])), MAP_HWC)
    assert {record.location for record in records} == {"01-0000-0000"}


def test_jpeg_tiles_are_close_to_the_map_and_photos_keep_their_bytes(tmp_path: Path) -> None:
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
def test_grey_maps_and_maps_with_transparency_are_read_too(tmp_path: Path, bands: int) -> None:
    root = miniature(tmp_path)
    four = np.dstack([MAP_HWC, np.full((40, 60), 255, np.uint8)])
    tiff(root / "01/satellite01.tif", four[:, :, :bands])
    records, _ = scanned(root, tile())
    expected = MAP_HWC[20:40, 40:60]
    if bands == 1:
        expected = np.repeat(expected[:, :, :1], 3, axis=2)
    assert np.array_equal(pixels(tile().read(records[-1])), expected)


def test_a_map_that_does_not_say_itself_where_it_lies_is_read_without_a_warning(
    tmp_path: Path,
) -> None:
    root = miniature(tmp_path)
    Image.fromarray(MAP_HWC).save(root / "01/satellite01.tif")
    records, refused = scanned(root, tile())
    assert not refused
    assert np.array_equal(pixels(tile().read(records[-1])), MAP_HWC[20:40, 40:60])


def test_a_map_of_16_bits_is_stretched_as_a_whole(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    ramp = np.dstack([np.tile(np.arange(60, dtype=np.uint16) * 100 + 1000, (40, 1))] * 3)
    tiff(root / "01/satellite01.tif", ramp)
    records, _ = scanned(root, tile())
    tiles = [pixels(tile().read(record)) for record in records if record.part]
    assert tiles[0][0, 0, 0] == 0
    assert tiles[2][0, -1, 0] == 255
    assert np.array_equal(tiles[0], tiles[3])  # one row below


def test_flights_for_training_keep_the_tiles_that_a_photo_shows(tmp_path: Path) -> None:
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


def split_map(root: Path) -> Path:
    """The same map in four files, cut at x 24 and y 16."""
    miniature(root)
    (root / "01/satellite01.tif").unlink()
    for row, rows in enumerate((slice(0, 16), slice(16, 40)), 1):
        for column, columns in enumerate((slice(0, 24), slice(24, 60)), 1):
            tiff(root / f"01/satellite01_0{row}-0{column}.tif", MAP_HWC[rows, columns])
    return root


def test_the_parts_of_a_map_share_its_corners(tmp_path: Path) -> None:
    source = tile(tile_pixels=100)
    records, refused = scanned(split_map(tmp_path), source)
    assert not refused
    tiles = {record.location: record for record in records if record.part}
    assert list(tiles) == [f"01_0{row}-0{column}-0000-0000" for row in (1, 2) for column in (1, 2)]
    last = tiles["01_02-02-0000-0000"].geotag
    assert last is not None
    assert (last.lat, last.lon) == pytest.approx((30.012, 120.042))
    assert np.array_equal(pixels(source.read(tiles["01_02-01-0000-0000"])), MAP_HWC[16:40, 0:24])


def test_a_map_with_a_part_missing_cannot_be_placed(tmp_path: Path) -> None:
    (split_map(tmp_path) / "01/satellite01_01-02.tif").unlink()
    with pytest.raises(InputError, match="no images below"):
        list(tile().scan(str(tmp_path)))
    refused: list[Rejection] = []
    with pytest.raises(InputError):
        refused.extend(item for item in tile().scan(str(tmp_path)) if isinstance(item, Rejection))
    assert [r.reason for r in refused] == ["incomplete map"] * 3 + ["off the map"] * 3


@pytest.mark.parametrize(
    "line",
    [
        "2,01_0002.JPG,,95,120.03,470,1,2,3,4",
        "2,01_0002.JPG,,nan,120.03,470,1,2,3,4",
        "2,01_0002.JPG,,30.03,inf,470,1,2,3,4",
        "2,01_0002.JPG,,30.03,120.03,high,1,2,3,4",
        "2,01_0002.JPG,yesterday,30.03,120.03,470,1,2,3,4",
        "2,01_0002.JPG",
    ],
)
def test_a_damaged_line_costs_its_own_photo_alone(tmp_path: Path, line: str) -> None:
    root = miniature(tmp_path)
    table = root / "01/01.csv"
    lines = table.read_text().splitlines()
    table.write_text("\n".join([lines[0], lines[1], line, lines[3]]))
    records, refused = scanned(root, tile())
    assert [Path(record.path).name for record in records if not record.part] == [
        "01_0001.JPG",
        "01_0003.JPG",
    ]
    assert [(Path(r.path).name, r.reason) for r in refused] == [
        ("01.csv", "unreadable tag"), ("01_0002.JPG", "no position")
    ]  # fmt: skip
    assert refused[0].found.startswith("line 3: 2,01_0002.JPG")


def test_a_flight_without_angles_has_photos_without_heading(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    (root / "01/01.csv").write_text(
        "\ufefffilename,date,lat,lon,height\n01_0001.jpg,,30.031,120.009,466\n"
    )
    records, _ = scanned(root, tile())
    assert records[0].geotag == GeoTag(lat=30.031, lon=120.009, altitude_m=466)


def test_a_photo_off_its_map_has_no_right_answer(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    (root / "01/01.csv").write_text(f"{PHOTOS}1,01_0001.JPG,,31,120.009,466,,,,\n")
    _, refused = scanned(root, tile())
    assert [(Path(r.path).name, r.reason) for r in refused] == [
        ("01_0001.JPG", "off the map"),
        ("01_0002.JPG", "no position"),
        ("01_0003.JPG", "no position"),
    ]


def test_maps_that_cannot_be_read_or_placed_are_told(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    touch(root / "02/drone/02_0001.JPG")
    touch(root / "02/satellite02.tif")
    touch(root / "02/satellite_extra.tif")
    (root / "02/02.csv").write_text(f"{PHOTOS}1,02_0001.JPG,,30.031,120.009,466,,,,\n")
    with (root / "satellite_ coordinates_range.csv").open("a") as table:
        table.write(
            "02.tif,30.04,120,30.0,120.06,as the example spells it\n03.tif,30,120,31,121,upside down\n"
        )
    records, refused = scanned(root, tile())
    assert len(records) == 9
    assert sorted((Path(r.path).name, r.reason) for r in refused) == [
        ("02_0001.JPG", "off the map"),
        ("satellite02.tif", "unreadable map"),
        ("satellite_ coordinates_range.csv", "unreadable tag"),
        ("satellite_extra.tif", "map without corners"),
    ]


def test_missing_tables_are_named(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    (root / "01/01.csv").unlink()
    with pytest.raises(
        InputError, match=r"no .*01/01\.csv; expected the flight's table of positions"
    ):
        scanned(root, tile())
    (root / "satellite_ coordinates_range.csv").unlink()
    with pytest.raises(InputError, match=r"no satellite_coordinates_range\.csv in"):
        scanned(root, tile())
    with pytest.raises(InputError, match=r"no folder .*expected UAV-VisLoc's root"):
        scanned(root / "nowhere", tile())


def test_odd_files_among_the_photos_are_refused(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    touch(root / "01/drone/Thumbs.db")
    touch(root / "01/drone/.DS_Store")
    touch(root / "01/drone/more/01_0004.JPG")
    (root / "09/drone").mkdir(parents=True)
    (root / "09/09.csv").write_text(PHOTOS)
    _, refused = scanned(root, tile())
    assert [(Path(r.path).name, r.reason) for r in refused] == [
        ("01_0004.JPG", "wrong folder")
    ]  # fmt: skip


def test_settings_that_make_no_tiles_are_refused() -> None:
    with pytest.raises(InputError, match="--tile-pixels is 0"):
        VisLoc(tile_pixels=0)
    with pytest.raises(InputError, match="--overlap is 1"):
        VisLoc(overlap=1)


def test_a_source_that_has_read_can_still_be_sent_to_workers_and_read_in_threads(
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
