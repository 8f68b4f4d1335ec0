"""Bytes of an image file -> pixels, RGB and upright.

Shapes: H x W pixels.
"""

import io
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import numpy.typing as npt
import simplejpeg
from PIL import Image, UnidentifiedImageError

Pixels = npt.NDArray[np.uint8]
PILLOW_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "GIF", "PPM")
"""Formats that Pillow may recognise, whatever the file's name. It knows forty more, some of them
seldom reviewed, and starts Ghostscript for a file that declares itself EPS."""
ORIENTATION_TAG = 0x0112
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
    if image.mode.startswith("I"):  # 16 bits a pixel, which Pillow's convert would clip at 255
        grey_HW = (np.asarray(image).astype(np.uint32) >> 8).astype(np.uint8)
        return np.repeat(grey_HW[:, :, None], 3, axis=2)
    if image.mode == "P":  # through RGBA: Pillow warns of every palette that holds transparency
        image = image.convert("RGBA")
    return np.asarray(image.convert("RGB"))


@contextmanager
def decode_errors(data: bytes) -> Iterator[None]:
    """Turn any error over an image's bytes into a DecodeError with a countable reason."""
    if not data:
        raise DecodeError("empty file", "0 bytes")
    try:
        yield
    except (DecodeError, MemoryError):  # the latter is this machine's fault and not the image's
        raise
    except UnidentifiedImageError:
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
