"""GeoTIFF mosaics: files, settings, threads."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pyproj
import pytest
from rasterio.control import GroundControlPoint

from pipeline.core.errors import InputError
from pipeline.core.records import Rejection, SkippedFile
from pipeline.images.decode import DecodeError, decode
from pipeline.sources.geotiff import GeoTiff
from tests.sources.mosaics import (
    UTM,
    half_empty,
    metres,
    mosaic,
    noise,
    pixels,
    refused,
    tag_of,
    tiles,
)


def test_geotiff_read_in_threads_gives_the_same_bytes(tmp_path: Path) -> None:
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


def test_geotiff_written_again_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "o.tif"
    [record] = tiles(mosaic(path, noise(3, 16, 16)))
    assert pixels(record).any()
    mosaic(path, np.zeros((3, 16, 17), np.uint8))
    assert not pixels(record).any()


def test_geotiff_reads_more_mosaics_than_it_keeps_open(tmp_path: Path) -> None:
    for number in range(12):
        mosaic(tmp_path / f"{number:02d}.tif", np.full((3, 8, 8), number, np.uint8))
    records = tiles(str(tmp_path))
    for record in [*records, *reversed(records)]:
        assert (pixels(record) == int(record.location[:2])).all()


def test_geotiff_folder_is_searched_at_any_depth(tmp_path: Path) -> None:
    for name in ("b/ortho.TIF", "a/deep/ortho.tiff", "ortho #1!.tif"):
        mosaic(tmp_path / name, noise(1, 8, 8))
    (tmp_path / "readme.txt").write_text("not a mosaic")
    (tmp_path / "map.jp2").write_text("not a mosaic that is read")
    others = [one.reason for one in GeoTiff().scan(str(tmp_path)) if isinstance(one, SkippedFile)]
    assert others == ["file that is no GeoTIFF (.jp2)", "file that is no GeoTIFF (.txt)"]
    locations = [record.location for record in tiles(str(tmp_path))]
    assert locations == ["a-deep-ortho-0-0", "b-ortho-0-0", "ortho #1!-0-0"]
    mosaic(tmp_path / "b-ortho.tif", noise(1, 8, 8))
    [rejection] = [found for found in GeoTiff().scan(str(tmp_path)) if isinstance(found, Rejection)]
    assert rejection.reason == "same name twice"


def test_geotiff_is_read_from_any_storage(tmp_path: Path) -> None:
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


def test_geotiff_without_coordinates_is_refused(tmp_path: Path) -> None:
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


def test_world_file_and_named_crs_place_a_plain_tiff(tmp_path: Path) -> None:
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


def test_damaged_geotiff_is_refused_without_gdal_output(
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


def test_complex_numbers_are_refused(tmp_path: Path) -> None:
    assert refused(mosaic(tmp_path / "sar.tif", noise(1, 8, 8, "complex64")))[0] == "not a picture"


def test_geotiff_terminal_line_describes_the_mosaic(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tiles(mosaic(tmp_path / "ortho.tif", noise(4, 64, 64), photometric="RGB"), tile_pixels=32)
    assert capsys.readouterr().err == (
        "ortho: 64 x 64 px of 0.5 x 0.5 m, EPSG:32633, uint8 as it is, bands 1, 2, 3 of 4, "
        "4 tiles of 32 x 32 px\n"
    )


def test_geotiff_levels_are_in_key_and_record(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = mosaic(tmp_path / "o.tif", noise(3, 64, 64))
    settings: dict[str, Any] = {"tile_m": (8.0, 16.0), "overlap": 0.5, "output_pixels": 8}
    records = tiles(root, **settings)
    assert "49 tiles of 16 x 16 px, 9 tiles of 32 x 32 px" in capsys.readouterr().err
    fine = [record for record in records if record.level == "8m"]
    coarse = [record for record in records if record.level == "16m"]
    assert (len(fine), len(coarse)) == (49, 9)
    assert coarse[-1].key == "gallery-satellite-o-16m-2-2-x0000032-y0000032-w32-h32"
    assert len({record.key for record in records}) == 58
    assert {record.location for record in fine}.isdisjoint(one.location for one in coarse)
    source = GeoTiff(encoding="png", **settings)
    assert all(decode(source.read(record)).shape == (8, 8, 3) for record in records)
    alone = tiles(root, tile_m=16.0, overlap=0.5)
    assert [one.geotag for one in alone] == [one.geotag for one in coarse]
    assert [one.location for one in alone[:2]] == ["o-0-0", "o-0-1"]
    assert tiles(root, tile_m=(16.0,), overlap=0.5) == alone


def test_geotiff_smaller_than_a_level_is_cut_once(tmp_path: Path) -> None:
    root = mosaic(tmp_path / "o.tif", noise(3, 64, 64))
    found = [record.location for record in tiles(root, tile_pixels=(50, 64, 100, 200))]
    assert found == [f"o-50px-{at}" for at in ("0-0", "0-1", "1-0", "1-1")] + ["o-64px-0-0"]


WRONG_SETTINGS: list[tuple[dict[str, Any], str]] = [
    ({"tile_m": 10.0, "tile_pixels": 10}, "both given"),
    ({"tile_pixels": 0}, "--tile-pixels is 0"),
    ({"tile_m": float("nan")}, "--tile-m is nan"),
    ({"tile_m": (60.0, -1.0)}, "--tile-m is 60.0 -1.0, expected a number above 0"),
    ({"tile_m": ()}, "--tile-m is nothing"),
    ({"tile_m": (60.0, 61.0)}, "--tile-m is 60.0 61.0, expected sizes that rise by 10% or more"),
    ({"tile_pixels": (512, 256)}, "sizes that rise"),
    ({"output_pixels": -1}, "--output-pixels is -1"),
    ({"overlap": 1.0}, "--overlap is 1.0"),
    ({"max_nodata": 1.5}, "--max-nodata is 1.5"),
    ({"stretch": (5.0, 5.0)}, "--stretch is 5.0 5.0"),
    ({"crs": "EPSG:99999999"}, "names no coordinate system"),
]


@pytest.mark.parametrize(("settings", "says"), WRONG_SETTINGS)
def test_geotiff_wrong_settings_are_refused(
    settings: dict[str, Any], says: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError, match=says):
        GeoTiff(**settings)
    assert capfd.readouterr().err == ""


def test_geotiff_without_mosaic_or_root_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no \.tif or \.tiff below"):
        list(GeoTiff().scan(str(tmp_path)))
    with pytest.raises(InputError, match="nothing at"):
        list(GeoTiff().scan(str(tmp_path / "nowhere.tif")))
