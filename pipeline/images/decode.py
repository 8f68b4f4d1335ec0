"""Bytes of a file -> pixels; the paper's train and test transforms per view, on uint8. The network
normalises.

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
"""What Pillow may take bytes for, whatever their name says. It knows forty more, some of them
seldom looked at, and has Ghostscript run what calls itself EPS."""
ORIENTATION_TAG = 0x0112
UPRIGHT_SLICES = {
    1: (slice(None), slice(None)),
    2: (slice(None), slice(None, None, -1)),
    3: (slice(None, None, -1), slice(None, None, -1)),
    4: (slice(None, None, -1), slice(None)),
}
"""What turns pixels upright, by EXIF orientation. Not ImageOps.exif_transpose: it writes all other
tags again, and fails where a camera gave one of them a type that is not its own."""
TRANSPOSED = {5: 1, 6: 2, 7: 3, 8: 4}
"The orientations that are one of UPRIGHT's once rows and columns are exchanged."


class DecodeError(ValueError):
    """Bytes that are not an image. `reason` is short and countable, the message says what was
    found.
    """

    def __init__(self, reason: str, found: str) -> None:
        super().__init__(f"{reason}: {found}")
        self.reason, self.found = reason, found


def decode(data: bytes) -> Pixels:
    """Encoded image -> pixels (H, W, 3), RGB, upright as its EXIF orientation says.

    Raises DecodeError.
    """
    with (
        decode_errors(data),
        Image.open(io.BytesIO(data), formats=PILLOW_FORMATS) as opened,
    ):  # reads the header only
        if opened.format in ("JPEG", "MPO") and opened.mode in (
            "RGB",
            "L",
        ):  # MPO: a JPEG that others follow
            return to_upright(simplejpeg.decode_jpeg(data, "RGB"), orientation_of(opened))
        opened.load()  # Pillow turns a TIFF upright here, and its tag is gone
        return to_upright(_rgb(opened), orientation_of(opened))


def _rgb(image: Image.Image) -> Pixels:
    if image.mode.startswith("I"):  # 16 bits a pixel, which Pillow's convert would clip at 255
        grey_HW = (np.asarray(image).astype(np.uint32) >> 8).astype(np.uint8)
        return np.repeat(grey_HW[:, :, None], 3, axis=2)
    if image.mode == "P":  # by way of RGBA: Pillow warns of every palette that holds transparency
        image = image.convert("RGBA")
    return np.asarray(image.convert("RGB"))


@contextmanager
def decode_errors(data: bytes) -> Iterator[None]:
    """Whatever goes wrong over an image's bytes becomes a DecodeError with a countable reason."""
    if not data:
        raise DecodeError("empty file", "0 bytes")
    try:
        yield
    except (DecodeError, MemoryError):  # the latter is this machine's fault and not the image's
        raise
    except UnidentifiedImageError:
        raise DecodeError(
            "not an image", f"{len(data)} bytes that begin with {data[:8]!r}"
        ) from None
    except Image.DecompressionBombError as error:
        raise DecodeError("too many pixels", str(error)) from None
    except Exception as error:  # Pillow raises many kinds over damaged headers and metadata
        raise DecodeError("damaged image", f"{len(data)} bytes; {error}") from None


def orientation_of(image: Image.Image) -> int:
    """The EXIF orientation, 1 (as it stands) to 8; 1 too where the image says none or one without a
    meaning.
    """
    said = image.getexif().get(ORIENTATION_TAG, 1)
    return said if said in UPRIGHT_SLICES or said in TRANSPOSED else 1


def to_upright(image_HW3: Pixels, orientation: int) -> Pixels:
    """Pixels as an image with that EXIF orientation holds them -> upright, one block of memory."""
    if orientation in TRANSPOSED:
        image_HW3, orientation = image_HW3.swapaxes(0, 1), TRANSPOSED[orientation]
    return np.ascontiguousarray(image_HW3[UPRIGHT_SLICES[orientation]])
