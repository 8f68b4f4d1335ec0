"""Small GeoTIFFs for tests, and the tiles that are cut from them."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import rasterio
from rasterio.enums import Resampling
from rasterio.errors import NotGeoreferencedWarning

from pipeline.core.records import GeoTag, ImageRecord, Rejection
from pipeline.images.decode import decode
from pipeline.sources.geotiff import GeoTiff

UTM = "EPSG:32633"
NORTH_UP = rasterio.Affine(0.5, 0, 400_000, 0, -0.5, 5_800_000)
TURNED = rasterio.Affine(
    0.4, 0.3, 400_000, 0.25, -0.45, 5_800_000
)  # by some 35 degrees, and sheared


def noise(bands: int, height: int, width: int, dtype: str = "uint8", top: int = 256) -> Any:
    return np.random.default_rng(0).integers(1, top, (bands, height, width)).astype(dtype)


def mosaic(
    path: Path, values_BHW: Any, *, crs: str | None = UTM, affine: Any = NORTH_UP, **options: Any
) -> str:
    """A GeoTIFF of these values. `kinds`, `palette`, `names` and `overviews` are set after it
    was opened.
    """
    kinds, palette, names, overviews = (
        options.pop(name, None) for name in ("kinds", "palette", "names", "overviews")
    )
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
        with rasterio.open(path, "w", driver="GTiff", **(shape | options)) as dataset:
            if kinds:
                dataset.colorinterp = kinds
            for band, name in enumerate(names or (), 1):
                if name:
                    dataset.set_band_description(band, name)
            if palette:
                dataset.write_colormap(1, palette)
            dataset.write(values_BHW)
            if overviews:
                dataset.build_overviews(overviews, Resampling.average)
    return str(path)


def quarters(folder: Path, values_BHW: Any, affine: Any = NORTH_UP, **options: Any) -> str:
    """The four quarters of a map as files of a folder."""
    _, height, width = values_BHW.shape
    for row in (0, 1):
        for column in (0, 1):
            y, x = row * height // 2, column * width // 2
            part = values_BHW[:, y : y + height // 2, x : x + width // 2]
            moved = affine @ rasterio.Affine.translation(x, y)
            mosaic(folder / f"{row}{column}.tif", part, affine=moved, **options)
    return str(folder)


def tiles(root: str, **settings: Any) -> list[ImageRecord]:
    found = list(GeoTiff(**settings).scan(root))
    assert not [one for one in found if isinstance(one, Rejection)], found
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


def half_empty(values_BHW: Any, empty: float) -> Any:
    """The left quarter of the columns is empty; of 4 tiles a row the first is."""
    values_BHW[:, :, : values_BHW.shape[2] // 4] = empty
    return values_BHW
