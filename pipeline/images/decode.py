"""Bytes of an image file -> pixels, RGB and upright.

Shapes: H x W pixels.
"""

import io
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import simplejpeg
from PIL import Image, UnidentifiedImageError

from pipeline.core.arrays import Pixels
from pipeline.images.libtiff import silence_libtiff
from pipeline.images.stretch import FEWEST_LEVELS, deep_to_8bit

PILLOW_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "GIF", "PPM")
"""Formats that Pillow may recognise, whatever the file's name. It knows forty more, some of them
seldom reviewed, and starts Ghostscript for a file that declares itself EPS."""
PILLOW_WARNINGS = ("ignore", None, Warning, re.compile(r"PIL\."), 0)
"The filter of warnings that Pillow's modules issue, as `warnings.filters` lists it."
ORIENTATION_TAG, PHOTOMETRIC_TAG, BITS_TAG, NODATA_TAG = 0x0112, 0x0106, 0x0102, 0xA481
WHITE_IS_ZERO = 0
TIFF_SIGNATURES = (b"II*\0", b"MM\0*")
UPRIGHT_SLICES = {
    1: (slice(None), slice(None)),
    2: (slice(None), slice(None, None, -1)),
    3: (slice(None, None, -1), slice(None, None, -1)),
    4: (slice(None, None, -1), slice(None)),
}
"""Slices that turn pixels upright, by EXIF orientation. Not ImageOps.exif_transpose: it rewrites
all other tags, and fails if a camera gave one of them the type of another."""
TRANSPOSED = {5: 1, 6: 2, 7: 3, 8: 4}
"Orientations that equal one of UPRIGHT_SLICES once rows and columns are exchanged."


class DecodeError(ValueError):
    """Bytes that are not an image. `reason` is short and countable, the message says what was
    found."""

    def __init__(self, reason: str, found: str) -> None:
        super().__init__(f"{reason}: {found}")
        self.reason, self.found = reason, found


def decode(data: bytes) -> Pixels:
    """Encoded image -> pixels (H, W, 3), RGB, upright as its EXIF orientation says.

    Raises DecodeError.
    """
    with (
        decode_errors(data),
        Image.open(io.BytesIO(data), formats=PILLOW_FORMATS) as opened,  # reads the header only
    ):
        # MPO: a JPEG that others follow
        if opened.format in ("JPEG", "MPO") and opened.mode in ("RGB", "L"):
            return to_upright(simplejpeg.decode_jpeg(data, "RGB"), orientation_of(opened))
        opened.load()  # Pillow turns a TIFF upright here, and removes its tag
        return to_upright(_rgb(opened), orientation_of(opened))


def _rgb(image: Image.Image) -> Pixels:
    tags = getattr(image, "tag_v2", {})  # a TIFF's
    if image.mode.startswith(("I", "F")):  # deeper than 8 bits, which Pillow's convert would clip
        grey_HW = deep_to_8bit(
            np.asarray(image), _nodata(tags), negative=tags.get(PHOTOMETRIC_TAG) == WHITE_IS_ZERO
        )
        return np.repeat(grey_HW[:, :, None], 3, axis=2)
    if image.mode == "P":  # through RGBA: Pillow warns of every palette that holds transparency
        image = image.convert("RGBA")
    image_HW3 = np.asarray(image.convert("RGB"))
    if max(tags.get(BITS_TAG, (8,))) > 8:  # of which Pillow keeps the upper 8
        _require_levels(image_HW3)
    return image_HW3


def _nodata(tags: Mapping[int, Any]) -> float | None:
    """The value of pixels without an image, as GDAL writes it; None if there is none."""
    try:
        return float(str(tags.get(NODATA_TAG, "")).strip("\0 "))
    except ValueError:
        return None


def _require_levels(image_HW3: Pixels) -> None:
    levels = int(image_HW3.max(initial=0)) + 1
    if levels < FEWEST_LEVELS:
        raise DecodeError(
            "too few levels",
            f"channels of 16 bits whose values fill {levels} of 256 levels, expected at least "
            f"{FEWEST_LEVELS}: stretch them, or give it to the geotiff source",
        )


@contextmanager
def decode_errors(data: bytes) -> Iterator[None]:
    """Turn any error over an image's bytes into a DecodeError with a countable reason.

    Pillow's warnings of odd metadata, and libtiff's lines about TIFF files, are not shown: they
    come with each photo of a camera.
    """
    if PILLOW_WARNINGS not in warnings.filters:
        warnings.filterwarnings("ignore", module=PILLOW_WARNINGS[3].pattern)
    if not data:
        raise DecodeError("empty file", "0 bytes")
    if data.startswith((b"II", b"MM")):
        silence_libtiff()
    try:
        yield
    except (DecodeError, MemoryError):  # the latter is this machine's fault and not the image's
        raise
    except UnidentifiedImageError:
        if data.startswith(TIFF_SIGNATURES):
            found = f"{len(data)} bytes of TIFF, cut off or with bands that Pillow does not read"
            raise DecodeError("damaged image", found) from None
        found = f"{len(data)} bytes that begin with {data[:8]!r}"
        raise DecodeError("not an image", found) from None
    except Image.DecompressionBombError as error:
        raise DecodeError("too many pixels", str(error)) from None
    except Exception as error:  # Pillow raises many kinds over damaged headers and metadata
        raise DecodeError("damaged image", f"{len(data)} bytes; {error}") from None


def orientation_of(image: Image.Image) -> int:
    """The EXIF orientation, 1 (as stored) to 8; 1 too if the image has none or one without a
    meaning."""
    orientation = image.getexif().get(ORIENTATION_TAG, 1)
    return orientation if orientation in UPRIGHT_SLICES or orientation in TRANSPOSED else 1


def to_upright(image_HW3: Pixels, orientation: int) -> Pixels:
    """Pixels stored with an EXIF orientation -> upright, in one block of memory."""
    if orientation in TRANSPOSED:
        image_HW3, orientation = image_HW3.swapaxes(0, 1), TRANSPOSED[orientation]
    return np.ascontiguousarray(image_HW3[UPRIGHT_SLICES[orientation]])
