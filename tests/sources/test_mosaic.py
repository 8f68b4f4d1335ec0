"""Pixels of tiles: bands, palettes, stretches, overviews, nodata."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio.enums import ColorInterp

from pipeline.core.errors import InputError
from pipeline.images.decode import decode
from pipeline.sources.geotiff import GeoTiff
from pipeline.sources.maps.colours import sample_values
from pipeline.sources.maps.mosaic import open_mosaic
from pipeline.sources.maps.tiles import parse_window
from tests.sources.mosaics import (
    half_empty,
    mosaic,
    noise,
    pixels,
    refused,
    tiles,
)


def test_png_tiles_equal_the_mosaics_windows(
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


def test_mosaic_smaller_than_a_tile_keeps_its_scale(tmp_path: Path) -> None:
    [record] = tiles(
        mosaic(tmp_path / "small.tif", noise(3, 30, 80)), tile_pixels=100, output_pixels=50
    )
    assert record.part == "x0000000-y0000000-w80-h30"
    assert pixels(record, tile_pixels=100, output_pixels=50).shape == (15, 40, 3)


def test_jpeg_tiles_are_close_and_reproducible(tmp_path: Path) -> None:
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


def test_bands_follow_their_colour_interpretation(tmp_path: Path) -> None:
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


def test_palette_is_expanded_and_resampled_as_colours(
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


def test_16_bits_are_stretched_by_percentiles_of_the_mosaic(
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


def test_sample_of_large_mosaic_without_overviews_is_patches(tmp_path: Path) -> None:
    values_1HW = np.tile(np.arange(5000, dtype=np.uint16), (1, 40, 1))
    found = np.concatenate(
        list(sample_values(open_mosaic(mosaic(tmp_path / "wide.tif", values_1HW)), (1,)))
    )
    assert len(found) == 16 * 16 * 64 * 40
    assert (found.min(), found.max()) == (0, 4999)
    assert abs(np.percentile(found, 50) - 2500) < 50


def test_stretch_of_one_value_and_of_no_value(tmp_path: Path) -> None:
    [record] = tiles(mosaic(tmp_path / "flat.tif", np.full((1, 8, 8), 700, np.uint16)))
    assert (pixels(record) == 0).all()
    [record] = tiles(
        mosaic(tmp_path / "none.tif", np.zeros((1, 8, 8), np.uint16), nodata=0), max_nodata=1.0
    )
    assert (pixels(record) == 0).all()


def test_smaller_output_is_read_from_overviews(tmp_path: Path) -> None:
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
def test_resampling_gives_the_requested_size(tmp_path: Path, resampling: str) -> None:
    [record] = tiles(mosaic(tmp_path / "o.tif", noise(3, 50, 50)), tile_pixels=50)
    shown = {"tile_pixels": 50, "resampling": resampling}
    assert pixels(record, **shown, output_pixels=20).shape == (20, 20, 3)
    assert pixels(record, **shown, output_pixels=70).shape == (70, 70, 3)


def test_tile_m_of_a_map_in_degrees_is_square(tmp_path: Path) -> None:
    affine = rasterio.Affine(5e-6, 0, 10, 0, -5e-6, 60)
    root = mosaic(tmp_path / "o.tif", noise(3, 300, 600), crs="EPSG:4326", affine=affine)
    record = tiles(root, tile_m=100.0)[0]
    assert pixels(record, tile_m=100.0, output_pixels=64).shape == (64, 64, 3)


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
def test_nodata_tiles_are_left_out_and_counted(
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


def test_nodata_needs_all_bands(tmp_path: Path) -> None:
    values_BHW = noise(3, 16, 16)
    values_BHW[0] = 0  # a dark red is no gap
    assert len(tiles(mosaic(tmp_path / "o.tif", values_BHW, nodata=0), max_nodata=0.0)) == 1


def test_nodata_is_not_searched_without_masks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: Any) -> float:
        raise AssertionError("masks were read")

    monkeypatch.setattr("pipeline.sources.geotiff.nodata_share", never)
    assert len(tiles(mosaic(tmp_path / "o.tif", noise(3, 32, 32)), tile_pixels=16)) == 4


# Bands as people name and order them


@pytest.mark.parametrize(
    ("names", "bands"),
    [
        (("blue", "green", "red", "nir"), (3, 2, 1)),
        (("Band 1 - Blue", "Band 2 - Green", "Band 3 - Red", "Band 4 - Near Infrared"), (3, 2, 1)),
        (("nir", "red edge", "red", "green", "blue"), (3, 4, 5)),
        (("green", "blue", "red"), (3, 1, 2)),
        (("red", "red", "blue"), (1, 2, 3)),
        ((None, "green", "red"), (1, 2, 3)),
    ],
)
def test_bands_follow_their_names(
    tmp_path: Path, names: tuple[str | None, ...], bands: tuple[int, ...]
) -> None:
    values_BHW = noise(len(names), 8, 8)
    root = mosaic(tmp_path / "a.tif", values_BHW, names=names)
    [record] = tiles(root)
    order = [band - 1 for band in bands]
    assert (pixels(record) == np.moveaxis(values_BHW[order], 0, -1)).all()


def test_bands_flag_goes_before_names(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values_BHW = noise(4, 8, 8)
    root = mosaic(tmp_path / "a.tif", values_BHW, names=("blue", "green", "red", "nir"))
    [record] = tiles(root, bands=(4, 3, 2))
    assert "bands 4, 3, 2 of 4 by --bands" in capsys.readouterr().err
    shown_HW3 = pixels(record, bands=(4, 3, 2))
    assert (shown_HW3 == np.moveaxis(values_BHW[[3, 2, 1]], 0, -1)).all()
    assert refused(root, bands=(5, 3, 2))[0] == "unknown colours"
    with pytest.raises(InputError, match="--bands is 0 1 2, expected numbers of bands, from 1"):
        GeoTiff(bands=(0, 1, 2))


def test_unnamed_bands_are_called_unnamed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kinds = [ColorInterp.undefined] * 4
    tiles(mosaic(tmp_path / "a.tif", noise(4, 8, 8, "uint16", 999), kinds=kinds))
    assert "taken for red, green, blue as none is named: --bands" in capsys.readouterr().err


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_white_is_zero_is_inverted(tmp_path: Path, dtype: str) -> None:
    ramp_1HW = np.tile(np.linspace(0, 250, 16).astype(dtype), (1, 16, 1))
    [record] = tiles(mosaic(tmp_path / "a.tif", ramp_1HW, photometric="MINISWHITE"))
    shown_HW = pixels(record)[:, :, 0]
    assert shown_HW[0, 0] > 245
    assert shown_HW[0, -1] < 10
    assert (np.diff(shown_HW, axis=1) <= 0).all()


def test_fewer_bits_than_a_byte_fill_the_range(tmp_path: Path) -> None:
    values_1HW = np.tile(np.arange(16, dtype=np.uint8), (1, 16, 1))
    [record] = tiles(mosaic(tmp_path / "a.tif", values_1HW, nbits=4))
    assert (pixels(record)[0, :, 0] == np.arange(16) * 17).all()
