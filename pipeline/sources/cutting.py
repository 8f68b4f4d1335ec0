"""Large rasters -> tiles: where they lie, and one tile's pixels as an encoded image.

In: a TIFF, local or at a URI that GDAL opens. Out: windows that cover it, bytes of a JPEG or PNG.
Shapes: H x W pixels, B bands. Open rasters are kept, one per path, process and thread: opening costs more than a window.
"""

import io
import os
import threading
import warnings
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import rasterio
from PIL import Image
from rasterio.errors import NotGeoreferencedWarning
from rasterio.windows import Window as RasterioWindow

from pipeline import storage
from pipeline.transforms import DecodeError

Encoding = Literal["jpg", "png"]
JPEG_QUALITY = 95  # PVDA sees 256 pixels of it; what is lost here is below the camera's own noise
_OPEN = threading.local()
_OPENING = threading.Lock()  # warnings' filters belong to the whole process


@dataclass(frozen=True, kw_only=True)
class Window:
    """A rectangle of a raster's pixels."""

    x: int
    "Of its left edge."
    y: int
    "Of its upper edge."
    width: int
    height: int

    @property
    def part(self) -> str:
        """As a record says it: `x-y-width-height`."""
        return f"{self.x}-{self.y}-{self.width}-{self.height}"

    @classmethod
    def of_part(cls, part: str) -> "Window":
        x, y, width, height = map(int, part.split("-"))
        return cls(x=x, y=y, width=width, height=height)


def starts(length: int, tile: int, overlap: float) -> list[int]:
    """Where tiles begin that cover `length` pixels; the last is moved back so that it ends with them, and only where the
    whole is smaller than a tile does one reach over."""
    if length <= tile:
        return [0]
    step = max(1, round(tile * (1 - overlap)))
    return [*range(0, length - tile, step), length - tile]


def grid(width: int, height: int, tile: int, overlap: float) -> dict[tuple[int, int], Window]:
    """Windows of `tile` pixels a side that cover a raster, by row and column; smaller only where the raster is."""
    return {
        (row, column): Window(x=x, y=y, width=min(tile, width), height=min(tile, height))
        for row, y in enumerate(starts(height, tile, overlap))
        for column, x in enumerate(starts(width, tile, overlap))
    }


def raster_size(path: str) -> tuple[int, int]:
    """Width and height; only the header is read. Raises OSError."""
    raster = _opened(path)
    return raster.width, raster.height


def read_window(path: str, window: Window, encoding: Encoding) -> bytes:
    """Pixels of a window, encoded; one band becomes grey, of four the last, transparency, is left out.

    Raises OSError, and DecodeError where the bands are not of 8 bits.
    """
    raster = _opened(path)
    if any(kind != "uint8" for kind in raster.dtypes):
        raise DecodeError("not 8 bits a band", f"bands of {', '.join(raster.dtypes)}")
    window_of_it = RasterioWindow(window.x, window.y, window.width, window.height)
    if raster.count < 3:
        image = Image.fromarray(raster.read(1, window=window_of_it))
    else:
        pixels_BHW = raster.read((1, 2, 3), window=window_of_it)
        image = Image.fromarray(np.ascontiguousarray(pixels_BHW.transpose(1, 2, 0)))
    stream = io.BytesIO()
    if encoding == "jpg":
        image.save(stream, "JPEG", quality=JPEG_QUALITY)
    else:
        image.save(stream, "PNG")
    return stream.getvalue()


def _opened(path: str) -> Any:
    """This thread's open raster of a path. A forked process shares its parent's file positions, so it opens its own."""
    if getattr(_OPEN, "process", None) != os.getpid():
        _OPEN.process, _OPEN.rasters = os.getpid(), {}
    if path not in _OPEN.rasters:
        with _OPENING, warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)  # tables say where these lie
            _OPEN.rasters[path] = rasterio.open(storage.locate(path)[1] if storage.is_local(path) else path)
    return _OPEN.rasters[path]
