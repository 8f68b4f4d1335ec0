"""Maps in several files: read as the one file that they were cut from, and what is refused."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp
from rasterio.errors import RasterioIOError

from pipeline.core.errors import InputError
from pipeline.sources.geotiff import GeoTiff
from pipeline.sources.maps.mosaic import colours_for, open_mosaic
from pipeline.sources.maps.sheets import as_one_map, has_gaps
from tests.sources.mosaics import (
    NORTH_UP,
    TURNED,
    UTM,
    mosaic,
    noise,
    pixels,
    quarters,
    refused,
    tiles,
)

SIDE = 64


@pytest.mark.parametrize("affine", [NORTH_UP, TURNED, NORTH_UP @ rasterio.Affine.scale(1, -1)])
@pytest.mark.parametrize("options", [{}, {"nodata": 0}, {"photometric": "RGB", "alpha": "yes"}])
def test_sheets_give_the_tiles_of_the_one_file(
    tmp_path: Path, affine: Any, options: dict[str, Any]
) -> None:
    """Keys, positions and pixels, of tiles across the seams too, and of gaps."""
    values_BHW = noise(4 if "alpha" in options else 3, SIDE, SIDE)
    if options:  # a gap across a seam
        values_BHW[:, 20:50, 10:40] = 0
    one = mosaic(tmp_path / "map.tif", values_BHW, affine=affine, **options)
    folder = quarters(tmp_path / "sheets", values_BHW, affine, **options)
    vrt = as_one_map(folder, str(tmp_path / "map.vrt"))
    cut: dict[str, Any] = {"tile_pixels": 24, "overlap": 0.5, "max_nodata": 0.4}
    expected, found = tiles(one, **cut), tiles(vrt, **cut)
    assert len(found) > 8
    assert [record.key for record in found] == [record.key for record in expected]
    assert [record.geotag for record in found] == [record.geotag for record in expected]
    for record, other in zip(found, expected, strict=True):
        assert (pixels(record, **cut) == pixels(other, **cut)).all()
    source = GeoTiff(encoding="png", **cut)
    with ThreadPoolExecutor(4) as pool:
        threaded = list(pool.map(source.read, found * 4))
    assert threaded == [source.read(record) for record in found] * 4


@pytest.mark.parametrize("dtype", ["uint16", "int16", "float32"])
def test_sheets_keep_their_values(tmp_path: Path, dtype: str) -> None:
    """A surface model, or more than 8 bits."""
    values_BHW = noise(1, SIDE, SIDE, dtype, 4000)
    vrt = as_one_map(quarters(tmp_path / "a", values_BHW, nodata=-9 if dtype != "uint16" else 0),
                     str(tmp_path / "map.vrt"))  # fmt: skip
    dataset = open_mosaic(vrt)
    assert dataset.dtypes == (dtype,)
    assert (dataset.read() == values_BHW).all()


def test_sheets_that_leave_a_gap_have_a_mask(tmp_path: Path) -> None:
    folder = quarters(tmp_path / "a", noise(3, SIDE, SIDE))
    assert not colours_for(as_one_map(folder, str(tmp_path / "full.vrt")), None).gaps
    (tmp_path / "a" / "11.tif").unlink()
    vrt = as_one_map(folder, str(tmp_path / "map.vrt"))
    assert colours_for(vrt, None).gaps
    assert open_mosaic(vrt).dataset_mask()[SIDE // 2 :, SIDE // 2 :].max() == 0
    assert open_mosaic(vrt).dataset_mask().mean() == pytest.approx(0.75 * 255)
    found = tiles(vrt, tile_pixels=SIDE // 4)
    assert len(found) == 12
    assert not has_gaps([(0, 0, 4, 4), (2, 2, 6, 4), (4, 0, 6, 2)])


def test_sheets_with_masks_show_what_lies_below(tmp_path: Path) -> None:
    """Two sheets of one ground: the upper one's masked half shows the lower one."""
    lower, upper = np.full((3, 16, 16), 9, np.uint8), np.full((3, 16, 16), 200, np.uint8)
    mosaic(tmp_path / "a" / "1.tif", lower)
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        mosaic(tmp_path / "a" / "2.tif", upper)
        with rasterio.open(tmp_path / "a" / "2.tif", "r+") as opened:
            opened.write_mask(np.repeat([[True] * 8 + [False] * 8], 16, axis=0))
    dataset = open_mosaic(as_one_map(str(tmp_path / "a"), str(tmp_path / "map.vrt")))
    read_HW = dataset.read(1)
    assert (read_HW[:, :8] == 200).all()
    assert (read_HW[:, 8:] == 9).all()
    assert dataset.dataset_mask().min() == 255


def test_sheets_of_degrees_lie_where_they_lay(tmp_path: Path) -> None:
    """Geographic coordinates: latitude and longitude are not swapped."""
    affine = rasterio.Affine(1e-5, 0, 11.0, 0, -1e-5, 47.0)
    folder = quarters(tmp_path / "a", noise(3, SIDE, SIDE), affine, crs="EPSG:4326")
    [record] = tiles(as_one_map(folder, str(tmp_path / "map.vrt")), tile_pixels=SIDE)
    assert record.geotag is not None
    assert (record.geotag.lat, record.geotag.lon) == pytest.approx((46.99968, 11.00032), abs=1e-7)


def test_sheets_unlike_each_other_are_refused(tmp_path: Path) -> None:
    mosaic(tmp_path / "a.tif", noise(3, 8, 8))
    vrt = str(tmp_path / "map.vrt")
    fine = NORTH_UP @ rasterio.Affine.scale(0.5)
    others: list[tuple[str, dict[str, Any]]] = [
        (r"in its coordinate system .*EPSG:32634 instead of EPSG:32633",
         {"crs": "EPSG:32634"}),
        (r"in its resolution .*0\.25 0 0 -0\.25 instead of 0\.5 0", {"affine": fine}),
        (r"in its nodata value \(0\.0 instead of None", {"nodata": 0}),
        (r"no coordinate system or transform", {"crs": None}),
        (r"has a palette", {"palette": {0: (1, 2, 3)}, "kinds": [ColorInterp.palette]}),
    ]  # fmt: skip
    for says, changes in others:
        bands = 1 if "palette" in changes else 3
        mosaic(tmp_path / "b.tif", noise(bands, 8, 8), **changes)
        with pytest.raises(InputError, match=says):
            as_one_map(str(tmp_path), vrt)
    mosaic(tmp_path / "b.tif", noise(1, 8, 8))
    with pytest.raises(InputError, match="in its bands"):
        as_one_map(str(tmp_path), vrt)
    (tmp_path / "b.tif").write_bytes(b"no TIFF")
    with pytest.raises(InputError, match=r"b\.tif is no GeoTIFF"):
        as_one_map(str(tmp_path), vrt)
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match=r"no \.tif or \.tiff below"):
        as_one_map(str(tmp_path / "none"), vrt)
    assert not Path(vrt).exists()


@pytest.mark.slow
def test_vrt_of_others_is_read_and_bounded(tmp_path: Path) -> None:
    """A VRT beside its sheets, by relative names; and one that names something else."""
    values_BHW = noise(3, SIDE, SIDE)
    folder = Path(quarters(tmp_path / "a", values_BHW))
    text = Path(as_one_map(str(folder), str(tmp_path / "map.vrt"))).read_text()
    own = folder / "own.vrt"
    own.write_text(text.replace(f"{folder}/", "").replace('relativeToVRT="0"', 'relativeToVRT="1"'))
    assert (open_mosaic(str(own)).read() == values_BHW).all()
    assert len(tiles(str(folder), tile_pixels=SIDE)) == 4  # a folder is searched for TIFFs only
    for name in ("/vsicurl/http://example.org/a.tif", "WMS:http://example.org", "map.xml"):
        own.write_text(text.replace(f"{folder}/00.tif", name))
        with pytest.raises(RasterioIOError, match="expected GeoTIFFs of this machine"):
            open_mosaic(str(own))
    own.write_text("no XML")
    assert refused(str(own))[0] == "damaged image"
    assert UTM in str(open_mosaic(str(tmp_path / "map.vrt")).crs)
