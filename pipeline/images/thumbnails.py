"""Small WebP pictures for HTML pages, as data URIs.

In: encoded images, by key. Out: thumbnails, each made once; None if an image is missing or
unreadable.
"""

import base64
import io
from collections.abc import Callable, Iterable, Mapping

from PIL import Image

from pipeline.core.arrays import Pixels
from pipeline.images.decode import DecodeError, decode

QUERY_PX = 360
ANSWER_PX = 180
WEBP_QUALITY, WEBP_EFFORT = 78, 2  # two thirds of JPEG's bytes at a similar look

ImageLoader = Callable[[Iterable[str]], dict[str, bytes]]
"Encoded images by key, of the keys that are found."


def no_images(keys: Iterable[str]) -> dict[str, bytes]:
    """An image loader that finds none."""
    return {}


class ThumbnailCache:
    """Thumbnails by key, each made once."""

    def __init__(self, images: Mapping[str, bytes]) -> None:
        self._images = images
        self._thumbnails: dict[tuple[str, int], str | None] = {}

    def __bool__(self) -> bool:
        return bool(self._images)

    def get(self, key: str, pixels: int) -> str | None:
        """A data URI; None if the image is missing or unreadable."""
        if (key, pixels) not in self._thumbnails:
            self._thumbnails[key, pixels] = thumbnail(self._images.get(key), pixels)
        return self._thumbnails[key, pixels]


def thumbnail(data: bytes | None, pixels: int) -> str | None:
    """A small WebP as a data URI, at most so many pixels a side; None without a readable image."""
    small = thumbnail_bytes(data, pixels)
    return None if small is None else as_data_uri(small)


def as_data_uri(webp: bytes) -> str:
    return f"data:image/webp;base64,{base64.b64encode(webp).decode()}"


def thumbnail_bytes(data: bytes | None, pixels: int) -> bytes | None:
    """A small WebP, at most so many pixels a side; None without a readable image."""
    if data is None:
        return None
    try:
        return shrink_to_webp(decode(data), pixels)
    except DecodeError:
        return None


def shrink_to_webp(pixels_HWC: Pixels, pixels: int) -> bytes:
    """A WebP of an image, RGB or RGBA, made smaller where a side exceeds `pixels`."""
    image, stream = Image.fromarray(pixels_HWC), io.BytesIO()
    image.thumbnail((pixels, pixels), Image.Resampling.LANCZOS)
    image.save(stream, "WEBP", quality=WEBP_QUALITY, method=WEBP_EFFORT)
    return stream.getvalue()
