"""TODO pipeline.images.thumbnails."""

import base64
import io
from collections.abc import Callable, Iterable, Mapping

from PIL import Image

from pipeline.images.decode import DecodeError, decode

ImageLoader = Callable[[Iterable[str]], dict[str, bytes]]
"Encoded images by key; keys that are not known are absent."


def no_images(keys: Iterable[str]) -> dict[str, bytes]:
    return {}


QUERY_PX = 360
ANSWER_PX = 180
WEBP_QUALITY, WEBP_EFFORT = 78, 2  # of WebP: two thirds of JPEG's bytes at a like look


class ThumbnailCache:
    """Thumbnails by key, each made once."""

    def __init__(self, images: Mapping[str, bytes]) -> None:
        self._images = images
        self._made: dict[tuple[str, int], str | None] = {}

    def __bool__(self) -> bool:
        return bool(self._images)

    def get(self, key: str, pixels: int) -> str | None:
        """A data URI; None where the picture is not at hand."""
        if (key, pixels) not in self._made:
            self._made[key, pixels] = thumbnail(self._images.get(key), pixels)
        return self._made[key, pixels]


def thumbnail(data: bytes | None, pixels: int) -> str | None:
    """A small WebP as a data URI; None without a picture that can be read."""
    if data is None:
        return None
    try:
        image = Image.fromarray(decode(data))
    except DecodeError:
        return None
    image.thumbnail((pixels, pixels), Image.Resampling.LANCZOS)
    stream = io.BytesIO()
    image.save(stream, "WEBP", quality=WEBP_QUALITY, method=WEBP_EFFORT)
    return f"data:image/webp;base64,{base64.b64encode(stream.getvalue()).decode()}"
