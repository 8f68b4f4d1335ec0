"""Bytes of a file -> pixels; the paper's train and test transforms per view, on uint8. The network normalises.

Shapes: H x W pixels.
"""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import simplejpeg
from PIL import Image, UnidentifiedImageError

from pipeline.records import View

Pixels = npt.NDArray[np.uint8]
PREPROCESSING = "resize bicubic pillow, ImageNet normalisation"
"Part of the fingerprint: tables made with another preprocessing do not mix."
ORIENTATION_TAG = 0x0112
UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180, 4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE, 6: Image.Transpose.ROTATE_270, 7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}  # fmt: skip
"""What turns an image upright, by EXIF orientation. Not ImageOps.exif_transpose: it writes all other tags again, and fails
where a camera gave one of them a type that is not its own."""


class DecodeError(ValueError):
    """Bytes that are not an image. `reason` is short and countable, the message says what was found."""

    def __init__(self, reason: str, found: str) -> None:
        super().__init__(f"{reason}: {found}")
        self.reason, self.found = reason, found


def decode(data: bytes) -> Pixels:
    """Encoded image -> pixels (H, W, 3), RGB, upright as its EXIF orientation says.

    Raises DecodeError.
    """
    with refusing(data), Image.open(io.BytesIO(data)) as opened:  # reads the header only
        if opened.format == "JPEG" and opened.mode in ("RGB", "L") and orientation_of(opened) == 1:
            rgb: Pixels = simplejpeg.decode_jpeg(data, "RGB")
            return rgb
        opened.load()  # Pillow turns a TIFF upright here, and its tag is gone
        orientation = orientation_of(opened)
        image = opened if orientation == 1 else opened.transpose(UPRIGHT[orientation])
        if image.mode.startswith("I"):  # 16 bits a pixel, which Pillow's convert would clip at 255
            grey_HW = (np.asarray(image).astype(np.uint32) >> 8).astype(np.uint8)
            return np.repeat(grey_HW[:, :, None], 3, axis=2)
        if image.mode == "P":  # by way of RGBA: Pillow warns of every palette that holds transparency
            image = image.convert("RGBA")
        return np.asarray(image.convert("RGB"))


@contextmanager
def refusing(data: bytes) -> Iterator[None]:
    """Whatever goes wrong over an image's bytes becomes a DecodeError with a countable reason."""
    if not data:
        raise DecodeError("empty file", "0 bytes")
    try:
        yield
    except (DecodeError, MemoryError):  # the latter is this machine's fault and not the image's
        raise
    except UnidentifiedImageError:
        raise DecodeError("not an image", f"{len(data)} bytes that begin with {data[:8]!r}") from None
    except Image.DecompressionBombError as error:
        raise DecodeError("too many pixels", str(error)) from None
    except Exception as error:  # Pillow raises many kinds over damaged headers and metadata
        raise DecodeError("damaged image", f"{len(data)} bytes; {error}") from None


def orientation_of(image: Image.Image) -> int:
    """The EXIF orientation, 1 (as it stands) to 8; 1 too where the image says none or one without a meaning."""
    said = image.getexif().get(ORIENTATION_TAG, 1)
    return said if said in UPRIGHT else 1


def resize(image_HW3: Pixels, size: int) -> Pixels:
    """To (size, size, 3) by antialiased bicubic, as Pillow does it."""
    if image_HW3.shape[:2] == (size, size):
        return image_HW3
    return np.asarray(Image.fromarray(image_HW3).resize((size, size), Image.Resampling.BICUBIC))


@dataclass(frozen=True, kw_only=True)
class Augmentation:
    """The train transforms. The defaults are the paper's."""

    pad: int = 10
    "Pixels added on each side by repeating the edge, out of which the image is cropped again [paper, LPN]."
    rotation: float = 90.0
    "Satellite images are turned by a random angle within +- this many degrees [paper, LPN]."
    mirror: bool = True
    "Whether half of the images are mirrored [paper, LPN]."


def augment(image_HW3: Pixels, view: View, size: int, settings: Augmentation, rng: np.random.Generator) -> Pixels:
    """Train transform of one image, (size, size, 3): resize, pad, turn (satellite only), crop, mirror.

    Turned corners are black and the nearest pixel is taken, as torchvision's RandomAffine does in LPN.
    """
    image_HW3 = resize(image_HW3, size)
    pad = settings.pad
    padded_HW3 = np.pad(image_HW3, ((pad, pad), (pad, pad), (0, 0)), mode="edge")
    if view == View.SATELLITE and settings.rotation:
        angle = float(rng.uniform(-settings.rotation, settings.rotation))
        padded_HW3 = np.asarray(Image.fromarray(padded_HW3).rotate(angle, Image.Resampling.NEAREST))
    top, left = rng.integers(0, 2 * pad, size=2, endpoint=True)
    cropped_HW3 = padded_HW3[top : top + size, left : left + size]
    if settings.mirror and rng.random() < 0.5:
        cropped_HW3 = cropped_HW3[:, ::-1]
    return np.ascontiguousarray(cropped_HW3)
