"""Opened mosaics, and their windows as pictures. In: the path of a TIFF, a window. Out: 8-bit RGB
or an image file of it, the share of nodata.

A GDAL data set may be used by one thread at a time, and not by a process forked from its own: each
process and thread opens its own, once. Shapes: B bands, H x W pixels.
"""

import io
import os
import threading
import warnings
from collections import OrderedDict
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import rasterio
import simplejpeg
from PIL import Image
from rasterio.enums import Resampling
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.windows import Window as RasterWindow

from pipeline.core import storage
from pipeline.images.decode import DecodeError, Pixels
from pipeline.sources.maps.colours import Colours, colours_of, to_8bit
from pipeline.sources.maps.tiles import Window

Encoding = Literal["jpg", "png"]
JPEG_QUALITY = 95  # with full colour resolution: what is lost cannot be seen, a tenth of PNG's size
# data sets kept open per thread: tiles come in the order of their keys' hashes, from all mosaics in
# turn
MAX_OPEN_DATASETS = 8
PILLOW_RESAMPLING = {
    Resampling.average: Image.Resampling.BOX,
    Resampling.bilinear: Image.Resampling.BILINEAR,
    Resampling.cubic: Image.Resampling.BICUBIC,
}
_open_datasets = threading.local()
_open_lock = threading.Lock()  # the filters of warnings belong to the whole process


def open_mosaic(path: str) -> Any:
    """This process's and thread's data set of a GeoTIFF; do not close it.

    Raises rasterio.errors.RasterioIOError when the file is none.
    """
    key = (os.getpid(), path, _file_version(path))
    if not hasattr(_open_datasets, "datasets"):
        _open_datasets.datasets = OrderedDict()
    datasets: OrderedDict[Any, Any] = _open_datasets.datasets
    if key not in datasets:
        datasets[key] = _open(path)
    datasets.move_to_end(key)
    while len(datasets) > MAX_OPEN_DATASETS:
        datasets.popitem(last=False)[1].close()
    return datasets[key]


def _file_version(path: str) -> tuple[int, ...]:
    """What changes when a local file is written again: a kept data set of it would show a mixture
    of both.
    """
    if not storage.is_local(path):
        return ()
    try:
        said = os.stat(storage.resolve(path)[1])
    except OSError:
        return ()  # opening it says what is wrong
    return said.st_mtime_ns, said.st_size


def _open(path: str) -> Any:
    # One driver: what a file's content would have others read (URLs, other files) is not for
    # imagery from elsewhere.
    filesystem, inner = storage.resolve(path)
    with _open_lock, warnings.catch_warnings():  # whoever needs coordinates looks for them
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        if storage.is_local(path):
            return rasterio.open(Path(inner), driver="GTiff")
        return rasterio.open(path, driver="GTiff", opener=filesystem)


def colours_for(path: str, stretch: tuple[float, float] | None) -> Colours:
    """How a mosaic's bands become RGB; found once per process, the same in all."""
    return _colours(path, _file_version(path), stretch)


@lru_cache(maxsize=256)
def _colours(path: str, version: tuple[int, ...], stretch: tuple[float, float] | None) -> Colours:
    return colours_of(open_mosaic(path), stretch)


def nodata_share(path: str, window: Window, shown: Colours) -> float:
    """The share of a window's pixels that hold no image, from 0 to 1: every pixel is looked at, at
    full resolution.
    """
    with rasterio.Env():  # outside of one, GDAL prints its errors
        valid_HW = _valid_mask(
            open_mosaic(path),
            _raster_window(window),
            shown,
            (window.height, window.width),
            Resampling.nearest,
        )
    return 1 - float(valid_HW.mean())


def read_window(
    path: str, window: Window, size: tuple[int, int], resampling: Resampling, shown: Colours
) -> Pixels:
    """A window as (H, W, 3) RGB of `size` (width, height), black where it holds no image.

    Where `size` is smaller GDAL reads the nearest finer overview. Raises
    rasterio.errors.RasterioIOError.
    """
    width, height = size
    with rasterio.Env():
        dataset, where = open_mosaic(path), _raster_window(window)
        if (
            shown.palette_N3 is not None
        ):  # the mean of two indices is no colour: full resolution, shrunk as colours
            index_HW = np.minimum(
                dataset.read(shown.bands[0], window=where), len(shown.palette_N3) - 1
            )
            image = Image.fromarray(shown.palette_N3[index_HW])
            if image.size != size:
                image = image.resize(size, PILLOW_RESAMPLING[resampling])
            rgb_HW3 = np.array(image)
        else:
            shape = (len(shown.bands), height, width)
            values_BHW = dataset.read(
                list(shown.bands), window=where, out_shape=shape, resampling=resampling
            )
            grey_or_rgb_HWB = np.moveaxis(to_8bit(values_BHW, shown.stretch), 0, -1)
            rgb_HW3 = np.array(np.broadcast_to(grey_or_rgb_HWB, (height, width, 3)), order="C")
        if shown.gaps:
            rgb_HW3[~_valid_mask(dataset, where, shown, (height, width), resampling)] = 0
    return rgb_HW3


def encode_window(
    path: str,
    window: Window,
    encoding: Encoding,
    size: tuple[int, int] | None = None,
    resampling: Resampling = Resampling.average,
    stretch: tuple[float, float] | None = None,
) -> bytes:
    """A window as an image file of `size`, by default its own; the same bytes each time.

    Raises DecodeError where the mosaic cannot be read.
    """
    try:
        own = (window.width, window.height)
        return encode_image(
            read_window(path, window, size or own, resampling, colours_for(path, stretch)), encoding
        )
    except RasterioError as error:
        raise DecodeError("damaged image", root_cause(error)) from None


def encode_image(image_HW3: Pixels, encoding: Encoding) -> bytes:
    """RGB as an image file; the same pixels give the same bytes."""
    if encoding == "jpg":
        jpeg: bytes = simplejpeg.encode_jpeg(
            image_HW3, quality=JPEG_QUALITY, colorspace="RGB", colorsubsampling="444"
        )
        return jpeg
    stream = io.BytesIO()
    Image.fromarray(image_HW3).save(stream, "PNG")
    return stream.getvalue()


def root_cause(error: BaseException) -> str:
    """What GDAL said first; rasterio's own words above it say that something was said."""
    while error.__cause__ is not None:
        error = error.__cause__
    return str(error)


def _valid_mask(
    dataset: Any,
    where: RasterWindow,
    shown: Colours,
    shape: tuple[int, int],
    resampling: Resampling,
) -> npt.NDArray[np.bool_]:
    """(H, W), true where a mask, alpha or nodata value leaves any of the shown bands, and it is a
    finite number.
    """
    bands = list(shown.bands[:1] if shown.one_mask else shown.bands)
    masks_BHW = dataset.read_masks(
        bands, window=where, out_shape=(len(bands), *shape), resampling=resampling
    )
    valid_HW: npt.NDArray[np.bool_] = (masks_BHW > 0).any(axis=0)
    if np.issubdtype(np.dtype(dataset.dtypes[0]), np.floating):
        bands = list(shown.bands)
        values_BHW = dataset.read(
            bands, window=where, out_shape=(len(bands), *shape), resampling=resampling
        )
        valid_HW &= np.isfinite(values_BHW).any(axis=0)
    return valid_HW


def _raster_window(window: Window) -> RasterWindow:
    return RasterWindow(window.x, window.y, window.width, window.height)
