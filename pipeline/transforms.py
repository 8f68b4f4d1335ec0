"""Bytes of a file -> pixels; the paper's train and test transforms per view, on uint8. The network normalises.

Shapes: H x W pixels.
"""

import io
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import simplejpeg
from PIL import Image, ImageOps, UnidentifiedImageError

from pipeline.records import View

Pixels = npt.NDArray[np.uint8]
PREPROCESSING = "resize bicubic pillow, ImageNet normalisation"
"Part of the fingerprint: tables made with another preprocessing do not mix."
ORIENTATION_TAG = 0x0112


class DecodeError(ValueError):
    """Bytes that are not an image. `reason` is short and countable, the message says what was found."""

    def __init__(self, reason: str, found: str) -> None:
        super().__init__(f"{reason}: {found}")
        self.reason, self.found = reason, found


def decode(data: bytes) -> Pixels:
    """Encoded image -> pixels (H, W, 3), RGB, upright as its EXIF orientation says.

    Raises DecodeError.
    """
    if not data:
        raise DecodeError("empty file", "0 bytes")
    try:
        with Image.open(io.BytesIO(data)) as image:  # reads the header only
            upright = image.getexif().get(ORIENTATION_TAG, 1) == 1
            if image.format == "JPEG" and image.mode in ("RGB", "L") and upright:
                rgb: Pixels = simplejpeg.decode_jpeg(data, "RGB")
                return rgb
            if image.mode.startswith("I"):  # 16 bits a pixel, which Pillow's convert would clip at 255
                grey_HW = (np.asarray(ImageOps.exif_transpose(image)).astype(np.uint32) >> 8).astype(np.uint8)
                return np.repeat(grey_HW[:, :, None], 3, axis=2)
            return np.asarray(ImageOps.exif_transpose(image).convert("RGB"))
    except UnidentifiedImageError:
        raise DecodeError("not an image", f"{len(data)} bytes that begin with {data[:8]!r}") from None
    except Image.DecompressionBombError as error:
        raise DecodeError("too many pixels", str(error)) from None
    except (OSError, ValueError, SyntaxError) as error:
        raise DecodeError("damaged image", f"{len(data)} bytes; {error}") from None


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
