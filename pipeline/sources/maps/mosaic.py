"""Reads windows of mosaics as 8-bit RGB.

In: the path of a TIFF, a window. Out: the window as RGB or as an image file; its share of nodata.
A GDAL data set may be used by one thread at a time, and not by a process forked from the one that
opened it, so each process and thread opens its own and keeps it. Shapes: B bands, H x W pixels.
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
from rasterio.errors import NotGeoreferencedWarning, RasterioError, RasterioIOError
from rasterio.windows import Window as RasterWindow

from pipeline.core import storage
from pipeline.core.arrays import Pixels
from pipeline.images.decode import DecodeError
from pipeline.images.stretch import to_8bit
from pipeline.sources.maps.bounded_xml import UnusableXml, elements, parse_xml
from pipeline.sources.maps.colours import Colours, UnknownColours, colours_of
from pipeline.sources.maps.tiles import Window

Encoding = Literal["jpg", "png"]
MOSAIC_SUFFIXES = (".tif", ".tiff")
SHEETS_SUFFIX = ".vrt"
"""Of GDAL's description of several GeoTIFFs as one, which is opened where it is named: a folder is
searched for TIFFs only."""
JPEG_QUALITY = 95  # with full colour resolution: what is lost cannot be seen, a tenth of PNG's size
MAX_OPEN_DATASETS = 8
"Per thread: tiles are read in the order of their keys' hashes, from all mosaics in turn."
PILLOW_RESAMPLING = {
    Resampling.average: Image.Resampling.BOX,
    Resampling.bilinear: Image.Resampling.BILINEAR,
    Resampling.cubic: Image.Resampling.BICUBIC,
}
_open_datasets = threading.local()
_open_lock = threading.Lock()  # the filters of warnings belong to the whole process


def open_mosaic(path: str) -> Any:
    """This process's and thread's data set of a GeoTIFF, or of a VRT of some; do not close it.

    Raises rasterio.errors.RasterioIOError when the file is neither.
    """
    key = (os.getpid(), path, file_version(path))
    if not hasattr(_open_datasets, "datasets"):
        _open_datasets.datasets = OrderedDict()
    datasets: OrderedDict[Any, Any] = _open_datasets.datasets
    if key not in datasets:
        datasets[key] = _open(path)
    datasets.move_to_end(key)
    while len(datasets) > MAX_OPEN_DATASETS:
        datasets.popitem(last=False)[1].close()
    return datasets[key]


def file_version(path: str) -> tuple[int, ...]:
    """Changes when a local file is written again; empty for a remote file. A data set that was
    opened before would show a mixture of the old and the new file.
    """
    if not storage.is_local(path):
        return ()
    try:
        status = os.stat(storage.resolve(path)[1])
    except OSError:
        return ()  # opening the file raises the error
    return status.st_mtime_ns, status.st_size


def _open(path: str, **options: str) -> Any:
    # Only this driver: other drivers follow URLs and paths that the file's content names, which is
    # unsafe for files of unknown origin.
    filesystem, inner = storage.resolve(path)
    driver = "GTiff"
    if storage.is_local(path) and inner.lower().endswith(SHEETS_SUFFIX):
        _check_sources(inner)
        driver = "VRT"
    with _open_lock, warnings.catch_warnings():  # a caller that needs coordinates checks for them
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        if storage.is_local(path):
            return rasterio.open(Path(inner), driver=driver, **options)
        return rasterio.open(path, driver="GTiff", opener=filesystem, **options)


def _check_sources(path: str) -> None:
    """Raises RasterioIOError where a VRT names anything but TIFF files of this machine."""
    try:
        root = parse_xml(Path(path).read_bytes())
    except (OSError, UnusableXml) as error:
        raise RasterioIOError(f"{path} is no VRT ({error}), expected one") from None
    for kind in ("SourceFilename", "SourceDataset"):
        for element in elements(root, kind):
            name = (element.text or "").strip()
            remote = "://" in name or "/vsi" in name
            if remote or not name.lower().endswith(MOSAIC_SUFFIXES):
                raise RasterioIOError(
                    f"{path} names {name or 'nothing'}, expected GeoTIFFs of this machine"
                )


def transform_by(path: str, source: str) -> rasterio.Affine | None:
    """The transform that one of GDAL's sources (INTERNAL, WORLDFILE, PAM) states; None where it
    states none.
    """
    with _open(path, GEOREF_SOURCES=source) as dataset:
        affine: rasterio.Affine = dataset.transform
        return None if affine.is_identity else affine


def colours_for(
    path: str, stretch: tuple[float, float] | None, bands: tuple[int, ...] | None = None
) -> Colours:
    """How the bands of a mosaic become RGB; computed once per process, equal in all processes.

    Raises UnknownColours, rasterio.errors.RasterioIOError.
    """
    return _colours(path, file_version(path), stretch, bands)


@lru_cache(maxsize=256)
def _colours(
    path: str,
    version: tuple[int, ...],
    stretch: tuple[float, float] | None,
    bands: tuple[int, ...] | None,
) -> Colours:
    return colours_of(open_mosaic(path), stretch, bands)


def nodata_share(path: str, window: Window, shown: Colours) -> float:
    """The share of a window's pixels without an image, from 0 to 1, counted at full resolution."""
    with rasterio.Env():  # outside of an Env GDAL prints its errors
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
        dataset, area = open_mosaic(path), _raster_window(window)
        # The mean of two indices is not a colour: read at full resolution and shrink as colours.
        if shown.palette_N3 is not None:
            index_HW = dataset.read(shown.bands[0], window=area)
            index_HW = np.minimum(index_HW, len(shown.palette_N3) - 1)
            image = Image.fromarray(shown.palette_N3[index_HW])
            if image.size != size:
                image = image.resize(size, PILLOW_RESAMPLING[resampling])
            rgb_HW3 = np.array(image)
        else:
            shape = (len(shown.bands), height, width)
            values_BHW = dataset.read(
                list(shown.bands), window=area, out_shape=shape, resampling=resampling
            )
            shown_BHW = to_8bit(values_BHW, shown.stretch, shown.negative)
            grey_or_rgb_HWB = np.moveaxis(shown_BHW, 0, -1)
            rgb_HW3 = np.array(np.broadcast_to(grey_or_rgb_HWB, (height, width, 3)), order="C")
        if shown.gaps:
            rgb_HW3[~_valid_mask(dataset, area, shown, (height, width), resampling)] = 0
    return rgb_HW3


def encode_window(
    path: str,
    window: Window,
    encoding: Encoding,
    size: tuple[int, int] | None = None,
    resampling: Resampling = Resampling.average,
    shown: Colours | None = None,
    flip: tuple[bool, bool] = (False, False),
) -> bytes:
    """A window as an image file of `size`, by default its own; the same bytes each time.

    `shown`: by default as the file says. `flip`: whether to mirror it left-right and upside down.
    Raises DecodeError where the mosaic cannot be read.
    """
    try:
        own, colours = (window.width, window.height), shown or colours_for(path, None)
        rgb_HW3 = read_window(path, window, size or own, resampling, colours)
    except RasterioError as error:
        raise DecodeError("damaged image", root_cause(error)) from None
    except UnknownColours as error:
        raise DecodeError("unknown colours", str(error)) from None
    columns, rows = (slice(None, None, -1 if mirrored else 1) for mirrored in flip)
    return encode_image(np.ascontiguousarray(rgb_HW3[rows, columns]), encoding)


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
    """GDAL's first error, which the exceptions of rasterio above it only wrap."""
    while error.__cause__ is not None:
        error = error.__cause__
    return str(error)


def _valid_mask(
    dataset: Any,
    area: RasterWindow,
    shown: Colours,
    shape: tuple[int, int],
    resampling: Resampling,
) -> npt.NDArray[np.bool_]:
    """(H, W), true where mask, alpha and nodata value leave a finite number in any of the shown
    bands.
    """
    bands = list(shown.bands[:1] if shown.one_mask else shown.bands)
    masks_BHW = dataset.read_masks(
        bands, window=area, out_shape=(len(bands), *shape), resampling=resampling
    )
    valid_HW: npt.NDArray[np.bool_] = (masks_BHW > 0).any(axis=0)
    if np.issubdtype(np.dtype(dataset.dtypes[0]), np.floating):
        bands = list(shown.bands)
        values_BHW = dataset.read(
            bands, window=area, out_shape=(len(bands), *shape), resampling=resampling
        )
        valid_HW &= np.isfinite(values_BHW).any(axis=0)
    return valid_HW


def _raster_window(window: Window) -> RasterWindow:
    return RasterWindow(window.x, window.y, window.width, window.height)
