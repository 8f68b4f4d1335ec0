"""Mosaics are cut without loss: every tile lies where its geotag says, shows what the mosaic shows,
and none is forgotten.
"""

import io
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pyproj
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from rasterio.control import GroundControlPoint
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import NotGeoreferencedWarning

from pipeline.core.errors import InputError
from pipeline.core.records import GeoTag, ImageRecord, Rejection
from pipeline.images.decode import DecodeError, decode
from pipeline.sources.geotiff import GeoTiff
from pipeline.sources.maps.colours import sample_values
from pipeline.sources.maps.georeference import Georeference, parse_crs
from pipeline.sources.maps.mosaic import open_mosaic
from pipeline.sources.maps.tiles import parse_window, plan_tiles, tile_starts

UTM = "EPSG:32633"
NORTH_UP = rasterio.Affine(0.5, 0, 400_000, 0, -0.5, 5_800_000)
TURNED = rasterio.Affine(
    0.4, 0.3, 400_000, 0.25, -0.45, 5_800_000
)  # by some 35 degrees, and sheared


def noise(bands: int, height: int, width: int, dtype: str = "uint8", top: int = 256) -> Any:
    return np.random.default_rng(0).integers(1, top, (bands, height, width)).astype(dtype)


def mosaic(
    path: Path, values_BHW: Any, *, crs: str | None = UTM, affine: Any = NORTH_UP, **said: Any
) -> str:
    """A GeoTIFF of these values. `kinds`, `palette`, `overviews` are said to GDAL after it was
    opened.
    """
    kinds, palette, overviews = (said.pop(name, None) for name in ("kinds", "palette", "overviews"))
    bands, height, width = values_BHW.shape
    shape = {
        "count": bands,
        "height": height,
        "width": width,
        "dtype": values_BHW.dtype,
        "crs": crs,
        "transform": affine,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", driver="GTiff", **(shape | said)) as dataset:
            if kinds:
                dataset.colorinterp = kinds
            if palette:
                dataset.write_colormap(1, palette)
            dataset.write(values_BHW)
            if overviews:
                dataset.build_overviews(overviews, Resampling.average)
    return str(path)


def tiles(root: str, **settings: Any) -> list[ImageRecord]:
    found = list(GeoTiff(**settings).scan(root))
    assert all(isinstance(record, ImageRecord) for record in found), found
    return [record for record in found if isinstance(record, ImageRecord)]


def refused(root: str, **settings: Any) -> tuple[str, str]:
    [rejection] = GeoTiff(**settings).scan(root)
    assert isinstance(rejection, Rejection)
    return rejection.reason, rejection.found


def pixels(record: ImageRecord, **settings: Any) -> Any:
    """(H, W, 3) of a tile, int so that differences are numbers."""
    return decode(GeoTiff(encoding="png", **settings).read(record)).astype(int)


def tag_of(record: ImageRecord) -> GeoTag:
    assert record.geotag is not None
    return record.geotag


def metres(one: tuple[float, float], other: tuple[float, float]) -> float:
    return float(pyproj.Geod(ellps="WGS84").inv(one[1], one[0], other[1], other[0])[2])


# The planner


@given(
    st.integers(1, 90),
    st.integers(1, 90),
    st.integers(1, 40),
    st.integers(1, 40),
    st.floats(0, 0.95),
)
def test_tiles_cover_every_pixel_and_stay_inside(
    width: int, height: int, across: int, down: int, overlap: float
) -> None:
    planned = plan_tiles((width, height), (across, down), overlap)
    covered_HW = np.zeros((height, width), bool)
    for tile in planned:
        window = tile.window
        assert min(window.x, window.y) >= 0
        assert (window.width, window.height) == (min(across, width), min(down, height))
        assert window.x + window.width <= width
        assert window.y + window.height <= height
        covered_HW[window.y : window.y + window.height, window.x : window.x + window.width] = True
        assert parse_window(window.part) == window
    assert covered_HW.all()
    assert (
        len({tile.window for tile in planned})
        == len({(tile.row, tile.column) for tile in planned})
        == len(planned)
    )
    assert plan_tiles((width, height), (across, down), overlap) == planned


@given(st.integers(1, 5000), st.integers(1, 600), st.floats(0, 0.95))
def test_neighbours_overlap_as_asked_and_the_last_ends_at_the_border(
    length: int, side: int, overlap: float
) -> None:
    begins = tile_starts(length, side, overlap)
    steps = np.diff(begins)
    assert set(steps[:-1]) <= {max(1, round(side * (1 - overlap)))}
    assert all(0 < step <= max(1, round(side * (1 - overlap))) for step in steps)
    assert begins[-1] + side == length or (begins == [0] and side > length)


def test_a_hand_worked_plan() -> None:
    assert tile_starts(1000, 400, 0.25) == [0, 300, 600]
    assert tile_starts(1001, 400, 0.25) == [0, 300, 600, 601]
    assert tile_starts(399, 400, 0.25) == [0]
    with pytest.raises(ValueError, match="is no window"):
        parse_window("x1-y2")


# Where tiles lie


@pytest.mark.parametrize("affine", [NORTH_UP, TURNED], ids=["north up", "turned and sheared"])
def test_centres_and_corners_match_pyprojs_to_under_a_centimetre(
    tmp_path: Path, affine: Any
) -> None:
    root = mosaic(tmp_path / "ortho.tif", noise(3, 150, 230), affine=affine)
    to_wgs84 = pyproj.Transformer.from_crs(UTM, "EPSG:4326", always_xy=True)
    found = tiles(root, tile_pixels=64, overlap=0.25)
    assert len(found) == 5 * 3
    for record in found:
        window, tag = parse_window(record.part), tag_of(record)
        left, top, right, bottom = (
            window.x,
            window.y,
            window.x + window.width,
            window.y + window.height,
        )
        places = [
            ((left + right) / 2, (top + bottom) / 2),
            (left, top),
            (right, top),
            (right, bottom),
            (left, bottom),
        ]
        assert tag.footprint is not None
        for place, said in zip(places, [(tag.lat, tag.lon), *tag.footprint], strict=True):
            lon, lat = to_wgs84.transform(*(affine @ place))
            assert metres((lat, lon), said) < 0.01


@pytest.mark.parametrize(
    ("crs", "affine", "across", "down"),
    [
        (UTM, NORTH_UP, 200, 200),
        # Mercator's metres are twice the ground's at 60 degrees.
        ("EPSG:3857", rasterio.Affine(0.5, 0, 1_000_000, 0, -0.5, 8_399_750), 399, 400),
        # A degree of longitude is half one of latitude there.
        ("EPSG:4326", rasterio.Affine(5e-6, 0, 10, 0, -5e-6, 60.0), 358, 180),
        ("EPSG:2263", rasterio.Affine(1, 0, 980_000, 0, -1, 200_000), 328, 328),  # US survey feet
        # the South Pole in its middle
        ("EPSG:3031", rasterio.Affine(0.5, 0, -128, 0, -0.5, 128), 195, 195),
    ],
)  # fmt: skip
def test_a_tile_of_100_metres_is_100_metres_on_the_ground(
    tmp_path: Path, crs: str, affine: Any, across: int, down: int
) -> None:
    root = mosaic(tmp_path / "ortho.tif", np.ones((1, 512, 512), np.uint8), crs=crs, affine=affine)
    found = tiles(root, tile_m=100.0)
    window = parse_window(found[0].part)
    assert (window.width, window.height) == (across, down)
    footprint = tag_of(found[0]).footprint
    assert footprint is not None
    upper_left, upper_right, lower_right, lower_left = footprint
    for one, other in [
        (upper_left, upper_right),
        (upper_right, lower_right),
        (lower_left, upper_left),
    ]:
        assert metres(one, other) == pytest.approx(100, abs=0.5)


@pytest.mark.parametrize(
    ("crs", "affine"),
    [
        ("EPSG:4326", rasterio.Affine(1e-4, 0, 179.995, 0, -1e-4, -17)),  # runs on to 180.005
        ("EPSG:3857", rasterio.Affine(10, 0, 20_037_008, 0, -10, -1_900_000)),
        ("EPSG:32760", rasterio.Affine(10, 0, 819_000, 0, -10, 8_117_000)),
    ],
)
def test_longitudes_stay_within_180_where_a_mosaic_crosses_the_date_line(
    tmp_path: Path, crs: str, affine: Any
) -> None:
    found = tiles(
        mosaic(tmp_path / "fiji.tif", noise(1, 50, 100), crs=crs, affine=affine), tile_pixels=50
    )
    west, east = (tag_of(record) for record in found)
    assert 179 < west.lon <= 180
    assert -180 <= east.lon < -179
    places = [place for tag in (west, east) for place in tag.footprint or ()]
    assert all(abs(lat) <= 90 and abs(lon) <= 180 for lat, lon in places)
    assert metres((west.lat, west.lon), (east.lat, east.lon)) < 600


def test_tiles_beyond_the_projection_are_left_out_and_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    globe = rasterio.Affine(20_000, 0, -8_000_000, 0, -20_000, 8_000_000)
    root = mosaic(
        tmp_path / "globe.tif",
        noise(1, 800, 800),
        crs="+proj=ortho +lat_0=40 +ellps=WGS84",
        affine=globe,
    )
    found = tiles(root, tile_pixels=100)
    assert 30 < len(found) < 64
    assert f"{64 - len(found)} left out as nowhere on Earth" in capsys.readouterr().err
    assert any(
        tag_of(record).footprint is None for record in found
    )  # its centre is on the disc, a corner is not
    assert all(np.isfinite((tag_of(record).lat, tag_of(record).lon)).all() for record in found)


# What tiles show


def test_a_png_tile_is_the_mosaics_window_and_the_last_row_and_column_are_kept(
    tmp_path: Path,
) -> None:
    values_BHW = noise(3, 150, 230)
    found = tiles(mosaic(tmp_path / "ortho.tif", values_BHW), tile_pixels=64, encoding="png")
    assert {record.part for record in found} >= {
        "x0000166-y0000086-w64-h64",
        "x0000000-y0000000-w64-h64",
    }
    assert [found[0].location, found[-1].location] == ["ortho-0-0", "ortho-2-3"]
    for record in found:
        window = parse_window(record.part)
        rows, columns = slice(window.y, window.y + 64), slice(window.x, window.x + 64)
        assert (pixels(record) == np.moveaxis(values_BHW[:, rows, columns], 0, -1)).all()


def test_a_mosaic_smaller_than_a_tile_is_one_smaller_tile_at_the_same_scale(tmp_path: Path) -> None:
    [record] = tiles(
        mosaic(tmp_path / "small.tif", noise(3, 30, 80)), tile_pixels=100, output_pixels=50
    )
    assert record.part == "x0000000-y0000000-w80-h30"
    assert pixels(record, tile_pixels=100, output_pixels=50).shape == (15, 40, 3)


def test_jpeg_tiles_are_close_to_the_mosaic_and_the_same_each_time(tmp_path: Path) -> None:
    smooth_BHW = np.stack([np.add.outer(np.arange(96), np.arange(96)) for _ in range(3)]).astype(
        np.uint8
    )
    source, [record] = (
        GeoTiff(tile_pixels=96),
        tiles(mosaic(tmp_path / "o.tif", smooth_BHW), tile_pixels=96),
    )
    data = source.read(record)
    assert data == source.read(record)
    assert source.ending(record) == "jpg"
    with Image.open(io.BytesIO(data)) as image:
        assert image.format == "JPEG"
    assert np.abs(decode(data).astype(int) - np.moveaxis(smooth_BHW, 0, -1)).max() <= 4


def test_colours_follow_the_bands_meaning(tmp_path: Path) -> None:
    kinds = [ColorInterp.undefined, ColorInterp.blue, ColorInterp.green, ColorInterp.red]
    values_BHW = noise(4, 20, 20)
    [record] = tiles(mosaic(tmp_path / "nbgr.tif", values_BHW, kinds=kinds))
    assert (pixels(record) == np.moveaxis(values_BHW[[3, 2, 1]], 0, -1)).all()
    [record] = tiles(
        mosaic(tmp_path / "unnamed.tif", values_BHW, kinds=[ColorInterp.undefined] * 4)
    )
    assert (pixels(record) == np.moveaxis(values_BHW[:3], 0, -1)).all()
    [record] = tiles(mosaic(tmp_path / "grey.tif", values_BHW[:1]))
    assert (pixels(record) == np.moveaxis(values_BHW[[0, 0, 0]], 0, -1)).all()
    kinds = [ColorInterp.gray, ColorInterp.alpha]
    [record] = tiles(mosaic(tmp_path / "grey-alpha.tif", values_BHW[:2], kinds=kinds))
    assert (pixels(record) == np.moveaxis(values_BHW[[0, 0, 0]], 0, -1)).all()


def test_a_palette_is_expanded_and_shrunk_as_colours(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    palette = {0: (255, 0, 0, 255), 1: (0, 0, 0, 255), 2: (0, 0, 200, 255)}
    index_1HW = np.tile(np.array([[0, 2], [2, 0]], np.uint8), (1, 8, 8))
    root = mosaic(tmp_path / "map.tif", index_1HW, palette=palette)
    [record] = tiles(root)
    assert (
        pixels(record)[:2, :2] == [[(255, 0, 0), (0, 0, 200)], [(0, 0, 200), (255, 0, 0)]]
    ).all()
    assert "palette" in capsys.readouterr().err
    halves = pixels(record, tile_pixels=16, output_pixels=8)
    assert np.abs(halves - (127.5, 0, 100)).max() <= 1  # the mean of the indices would be black


def test_16_bits_are_stretched_between_percentiles_of_the_whole_mosaic(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values_BHW = noise(3, 200, 200, "uint16", top=2048)  # 11 bits
    values_BHW[:, :, :100] //= 2
    found = tiles(mosaic(tmp_path / "worldview.tif", values_BHW), tile_pixels=100)
    low, high = np.percentile(values_BHW, (2, 98))
    assert f"uint16 stretched from {low:.6g}..{high:.6g}" in capsys.readouterr().err
    for record in found:  # one stretch for all: tiles fit together
        window = parse_window(record.part)
        shown_BHW = values_BHW[:, window.y : window.y + 100, window.x : window.x + 100]
        expected_BHW = np.clip((shown_BHW - low) / (high - low) * 255, 0, 255)
        assert np.abs(pixels(record) - np.moveaxis(expected_BHW, 0, -1)).max() <= 0.51
    given_by_hand = pixels(found[0], stretch=(0.0, 2550.0))
    assert np.abs(given_by_hand - np.moveaxis(values_BHW[:, :100, :100], 0, -1) / 10).max() <= 0.51


def test_a_large_mosaic_without_overviews_is_sampled_in_patches(tmp_path: Path) -> None:
    values_1HW = np.tile(np.arange(5000, dtype=np.uint16), (1, 40, 1))
    found = np.concatenate(
        list(sample_values(open_mosaic(mosaic(tmp_path / "wide.tif", values_1HW)), (1,)))
    )
    assert len(found) == 16 * 16 * 64 * 40
    assert (found.min(), found.max()) == (0, 4999)
    assert abs(np.percentile(found, 50) - 2500) < 50


def test_a_mosaic_of_one_value_and_one_of_none_have_a_stretch_too(tmp_path: Path) -> None:
    [record] = tiles(mosaic(tmp_path / "flat.tif", np.full((1, 8, 8), 700, np.uint16)))
    assert (pixels(record) == 0).all()
    [record] = tiles(
        mosaic(tmp_path / "none.tif", np.zeros((1, 8, 8), np.uint16), nodata=0), max_nodata=1.0
    )
    assert (pixels(record) == 0).all()


def test_coarser_tiles_come_from_overviews_and_are_close_to_the_areas_mean(tmp_path: Path) -> None:
    fine_BHW = noise(3, 256, 256)
    root = mosaic(
        tmp_path / "o.tif", fine_BHW, overviews=[2, 4], tiled=True, blockxsize=64, blockysize=64
    )
    mean_HW3 = np.moveaxis(fine_BHW.reshape(3, 64, 4, 64, 4).mean(axis=(2, 4)), 0, -1)
    [record] = tiles(root, tile_pixels=256)
    shown_HW3 = pixels(record, tile_pixels=256, output_pixels=64)
    assert np.abs(shown_HW3 - mean_HW3).max() <= 2
    with rasterio.open(
        root, "r+"
    ) as dataset:  # an overview that differs from the mosaic shows that it is the one read
        dataset.write(np.zeros_like(fine_BHW))
    assert (pixels(record, tile_pixels=256, output_pixels=64) == shown_HW3).all()
    assert (pixels(record, tile_pixels=256) == 0).all()


@pytest.mark.parametrize("resampling", ["average", "bilinear", "cubic"])
def test_every_resampling_gives_the_size_asked_for(tmp_path: Path, resampling: str) -> None:
    [record] = tiles(mosaic(tmp_path / "o.tif", noise(3, 50, 50)), tile_pixels=50)
    shown = {"tile_pixels": 50, "resampling": resampling}
    assert pixels(record, **shown, output_pixels=20).shape == (20, 20, 3)
    assert pixels(record, **shown, output_pixels=70).shape == (70, 70, 3)


def test_square_tiles_come_from_a_map_in_degrees(tmp_path: Path) -> None:
    affine = rasterio.Affine(5e-6, 0, 10, 0, -5e-6, 60)
    root = mosaic(tmp_path / "o.tif", noise(3, 300, 600), crs="EPSG:4326", affine=affine)
    record = tiles(root, tile_m=100.0)[0]
    assert pixels(record, tile_m=100.0, output_pixels=64).shape == (64, 64, 3)


# Nodata


def half_empty(values_BHW: Any, empty: float) -> Any:
    """The left quarter of the columns is empty; of 4 tiles a row the first is."""
    values_BHW[:, :, : values_BHW.shape[2] // 4] = empty
    return values_BHW


def alpha(values_BHW: Any) -> Any:
    return np.concatenate(
        [values_BHW, half_empty(np.full((1, *values_BHW.shape[1:]), 255, np.uint8), 0)]
    )


def made_with_nodata(kind: str, path: Path) -> str:
    values_BHW = noise(3, 64, 64)
    if kind == "nodata":
        return mosaic(path, half_empty(values_BHW, 0), nodata=0)
    if kind == "alpha":
        return mosaic(path, alpha(values_BHW), photometric="RGB", alpha="YES")
    if kind == "uint16":
        return mosaic(path, half_empty(noise(3, 64, 64, "uint16", 4096), 65535), nodata=65535)
    floats_BHW = half_empty(values_BHW.astype(np.float32), np.nan)
    return (
        mosaic(path, floats_BHW, nodata=np.nan) if kind == "NaN said" else mosaic(path, floats_BHW)
    )


@pytest.mark.parametrize("kind", ["nodata", "alpha", "uint16", "NaN said", "NaN unsaid"])
def test_tiles_of_nodata_are_left_out_and_counted(
    tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    root = made_with_nodata(kind, tmp_path / "ortho.tif")
    found = tiles(root, tile_pixels=16)
    assert [parse_window(record.part).x for record in found[:3]] == [16, 32, 48]
    assert "12 tiles of 16 x 16 px, 4 left out as nodata" in capsys.readouterr().err
    assert (
        len(tiles(root, tile_pixels=32, max_nodata=0.5)) == 4
    )  # exactly half is not more than half
    assert len(tiles(root, tile_pixels=32, max_nodata=0.49)) == 2
    [whole] = tiles(root, tile_pixels=64)
    shown_HW3 = pixels(whole)
    assert (shown_HW3[:, :16] == 0).all()
    assert shown_HW3[:, 16:].max() == 255  # the empty value did not take part in the stretch
    halves = pixels(whole, tile_pixels=64, output_pixels=32)
    assert (halves[:, :8] == 0).all()
    assert halves[:, 8].mean() == pytest.approx(128, abs=20)  # and does not darken its neighbours


def test_nodata_is_where_all_bands_have_it(tmp_path: Path) -> None:
    values_BHW = noise(3, 16, 16)
    values_BHW[0] = 0  # a dark red is no gap
    assert len(tiles(mosaic(tmp_path / "o.tif", values_BHW, nodata=0), max_nodata=0.0)) == 1


def test_a_mosaic_without_gaps_is_not_searched_for_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: Any) -> float:
        raise AssertionError("masks were read")

    monkeypatch.setattr("pipeline.sources.geotiff.nodata_share", never)
    assert len(tiles(mosaic(tmp_path / "o.tif", noise(3, 32, 32)), tile_pixels=16)) == 4


# Threads


def test_threads_read_the_same_bytes_as_one(tmp_path: Path) -> None:
    root = mosaic(
        tmp_path / "o.tif",
        half_empty(noise(3, 256, 256, "uint16", 4096), 0),
        nodata=0,
        compress="deflate",
    )
    source = GeoTiff(tile_pixels=64, overlap=0.5, output_pixels=32)
    records = tiles(root, tile_pixels=64, overlap=0.5, output_pixels=32)
    one_by_one = [source.read(record) for record in records]
    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(source.read, records * 4)) == one_by_one * 4
    assert tiles(root, tile_pixels=64, overlap=0.5) == records


def test_a_mosaic_written_again_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "o.tif"
    [record] = tiles(mosaic(path, noise(3, 16, 16)))
    assert pixels(record).any()
    mosaic(path, np.zeros((3, 16, 17), np.uint8))
    assert not pixels(record).any()


def test_more_mosaics_than_are_kept_open_are_read_in_turn(tmp_path: Path) -> None:
    for number in range(12):
        mosaic(tmp_path / f"{number:02d}.tif", np.full((3, 8, 8), number, np.uint8))
    records = tiles(str(tmp_path))
    for record in [*records, *reversed(records)]:
        assert (pixels(record) == int(record.location[:2])).all()


# Files and settings


def test_a_folder_is_searched_at_any_depth_and_names_stay_apart(tmp_path: Path) -> None:
    for name in ("b/ortho.TIF", "a/deep/ortho.tiff", "ortho #1!.tif"):
        mosaic(tmp_path / name, noise(1, 8, 8))
    (tmp_path / "readme.txt").write_text("not a mosaic")
    locations = [record.location for record in tiles(str(tmp_path))]
    assert locations == ["a-deep-ortho-0-0", "b-ortho-0-0", "ortho #1!-0-0"]
    mosaic(tmp_path / "b-ortho.tif", noise(1, 8, 8))
    [rejection] = [found for found in GeoTiff().scan(str(tmp_path)) if isinstance(found, Rejection)]
    assert rejection.reason == "same name twice"


def test_a_mosaic_is_read_from_any_storage(tmp_path: Path) -> None:
    values_BHW = noise(3, 40, 40)
    filesystem = fsspec.filesystem("memory")
    filesystem.pipe_file(
        "/mosaics/sub/o 1.tif", Path(mosaic(tmp_path / "o.tif", values_BHW)).read_bytes()
    )
    try:
        [record] = tiles("memory://mosaics")
        assert record.location == "sub-o 1-0-0"
        assert (pixels(record) == np.moveaxis(values_BHW, 0, -1)).all()
    finally:
        filesystem.rm("/mosaics", recursive=True)
    [record] = tiles(f"file://{tmp_path}/o.tif")
    assert (pixels(record) == np.moveaxis(values_BHW, 0, -1)).all()


def test_files_without_coordinates_are_refused(tmp_path: Path) -> None:
    values_BHW = noise(1, 8, 8)
    no_crs = mosaic(tmp_path / "no-crs.tif", values_BHW, crs=None)
    assert refused(no_crs) == (
        "no coordinates",
        "no coordinate system; expected one: name it with --crs EPSG:...",
    )
    nothing = mosaic(tmp_path / "nothing.tif", values_BHW, crs=None, affine=None)
    assert refused(nothing, crs=UTM)[0] == "no coordinates"
    points = [GroundControlPoint(row, column, column, row) for row in (0, 8) for column in (0, 8)]
    by_points = mosaic(tmp_path / "gcp.tif", values_BHW, crs=UTM, affine=None, gcps=points)
    assert refused(by_points)[0] == "no coordinates"
    assert "4 ground control points" in refused(by_points)[1]
    local = mosaic(tmp_path / "local.tif", values_BHW, crs='LOCAL_CS["site",UNIT["metre",1]]')
    assert refused(local) == ("no coordinates", "its centre lies nowhere on Earth by site")


def test_a_world_file_beside_a_plain_tiff_and_a_named_crs_are_enough(tmp_path: Path) -> None:
    path = tmp_path / "scan.tif"
    mosaic(path, noise(1, 8, 8), crs=None, affine=None)
    path.with_suffix(".tfw").write_text(
        "0.5\n0\n0\n-0.5\n400000.25\n5799999.75\n"
    )  # the first pixel's middle
    assert refused(str(path))[0] == "no coordinates"
    [record] = tiles(str(path), crs=UTM)
    lon, lat = pyproj.Transformer.from_crs(UTM, "EPSG:4326", always_xy=True).transform(
        400_002, 5_799_998
    )
    assert metres((lat, lon), (tag_of(record).lat, tag_of(record).lon)) < 0.01


def test_damaged_files_are_refused_and_nothing_leaks_to_the_screen(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty.tif").write_bytes(b"")
    (tmp_path / "page.tif").write_text("<html>not found</html>")
    (tmp_path / "header.tif").write_bytes(b"II*\0garbage")
    for root in ("empty", "page", "header"):
        assert refused(str(tmp_path / f"{root}.tif"))[0] == "damaged image"
    whole = Path(
        mosaic(tmp_path / "a.tif", noise(3, 64, 64), tiled=True, blockxsize=16, blockysize=16)
    ).read_bytes()
    cut = tmp_path / "cut.tif"
    cut.write_bytes(whole[: len(whole) // 2])
    first, *_, last = tiles(str(cut), tile_pixels=16)
    assert pixels(first).any()
    with pytest.raises(DecodeError, match=r"damaged image.*TIFFReadEncodedTile"):
        GeoTiff().read(last)
    masked = Path(mosaic(tmp_path / "m.tif", noise(3, 64, 64), nodata=0)).read_bytes()
    cut.write_bytes(masked[: len(masked) // 2])
    assert refused(str(cut))[0] == "damaged image"  # its nodata cannot be counted
    cut.unlink()
    with pytest.raises(DecodeError, match=r"damaged image.*[Nn]o such file"):
        GeoTiff().read(first)
    leaked = [
        line for line in capfd.readouterr().err.splitlines() if not line.startswith(("cut: ", "{"))
    ]
    assert leaked == []


def test_numbers_that_cannot_be_shown_are_refused(tmp_path: Path) -> None:
    assert refused(mosaic(tmp_path / "sar.tif", noise(1, 8, 8, "complex64")))[0] == "not a picture"


def test_the_terminal_is_told_what_was_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tiles(mosaic(tmp_path / "ortho.tif", noise(4, 64, 64), photometric="RGB"), tile_pixels=32)
    assert capsys.readouterr().err == (
        "ortho: 64 x 64 px of 0.5 x 0.5 m, EPSG:32633, uint8 as it is, bands 1, 2, 3 of 4, 4 tiles of 32 x 32 px\n"
    )


WRONG_SETTINGS: list[tuple[dict[str, Any], str]] = [
    ({"tile_m": 10.0, "tile_pixels": 10}, "both given"),
    ({"tile_pixels": 0}, "--tile-pixels is 0"),
    ({"tile_m": float("nan")}, "--tile-m is nan"),
    ({"output_pixels": -1}, "--output-pixels is -1"),
    ({"overlap": 1.0}, "--overlap is 1.0"),
    ({"max_nodata": 1.5}, "--max-nodata is 1.5"),
    ({"stretch": (5.0, 5.0)}, "--stretch is 5.0 5.0"),
    ({"crs": "EPSG:99999999"}, "names no coordinate system"),
]


@pytest.mark.parametrize(("settings", "says"), WRONG_SETTINGS)
def test_wrong_settings_are_refused_with_a_sentence(
    settings: dict[str, Any], says: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError, match=says):
        GeoTiff(**settings)
    assert capfd.readouterr().err == ""


def test_no_mosaic_and_no_root_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no \.tif or \.tiff below"):
        list(GeoTiff().scan(str(tmp_path)))
    with pytest.raises(InputError, match="nothing at"):
        list(GeoTiff().scan(str(tmp_path / "nowhere.tif")))


def test_a_pixels_size_is_found_although_one_place_around_it_is_nowhere() -> None:
    crs = parse_crs("+proj=ortho +ellps=WGS84")
    assert crs is not None
    disc = Georeference(crs=crs, affine=rasterio.Affine(1000, 0, 6_370_000, 0, -1000, 0))
    assert np.isnan(disc.degrees(np.array([(0, 0), (100.0, 0)]))[:, 0]).tolist() == [False, True]
