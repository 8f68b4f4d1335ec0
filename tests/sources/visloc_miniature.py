"""A miniature of UAV-VisLoc for tests."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rasterio
from PIL import Image

from pipeline.core.records import ImageRecord, Rejection
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


def split_map(root: Path) -> Path:
    """The same map in four files, cut at x 24 and y 16."""
    miniature(root)
    (root / "01/satellite01.tif").unlink()
    for row, rows in enumerate((slice(0, 16), slice(16, 40)), 1):
        for column, columns in enumerate((slice(0, 24), slice(24, 60)), 1):
            tiff(root / f"01/satellite01_0{row}-0{column}.tif", MAP_HWC[rows, columns])
    return root
