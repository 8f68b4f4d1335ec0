"""Images from anywhere: a size or pixels, or a reason that can be counted.

No other program is started, and no size is trusted.
"""

import io
import struct
import zlib
from functools import cache

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from pipeline.images.decode import DecodeError, decode
from pipeline.images.inspect import inspect
from pipeline.images.transforms import resize
from tests.fuzz.bounds import bounded, examples
from tests.fuzz.hostile import damaged

FORMS = [
    "JPEG",
    "PNG",
    "WEBP",
    "TIFF",
    "BMP",
    "GIF",
    "PPM",
    "JPEG2000",
    "TGA",
    "ICO",
    "PCX",
    "SGI",
    "DDS",
    "ICNS",
    "EPS",
    "PDF",
]
MODES = ["RGB", "L", "RGBA", "P", "CMYK", "I;16", "I", "F", "1", "LA", "YCbCr", "LAB"]


@cache
def encoded_image(form: str, mode: str, frames: int = 1) -> bytes:
    """A small image; empty where that format has no such mode."""
    stream = io.BytesIO()
    image = Image.effect_noise((24, 16), 40).convert("RGB")
    try:
        image = Image.new(mode, (24, 16)) if mode in ("I;16", "LAB") else image.convert(mode)
        more = (
            {"save_all": True, "append_images": [image.rotate(90)] * (frames - 1)}
            if frames > 1
            else {}
        )
        image.save(stream, form, **more)
    except (OSError, KeyError, ValueError, SystemError):
        return b""
    return stream.getvalue()


def judge(data: bytes) -> None:
    with bounded(DecodeError):
        inspect(data)
    with bounded(DecodeError):
        pixels = decode(data)
        assert pixels.ndim == 3
        assert pixels.shape[2] == 3
        resize(pixels, 32, "pillow")


@pytest.mark.filterwarnings(
    "ignore"
)  # Pillow warns of what it then reads or refuses; packing is a process that shows none
@given(
    st.data(),
    st.sampled_from(FORMS),
    st.sampled_from(MODES),
    st.sampled_from([1, 1, 3]),
    st.booleans(),
)
@examples(250)
def test_image_of_any_format_and_damage_is_bounded(
    data: st.DataObject, form: str, mode: str, frames: int, is_intact: bool
) -> None:
    content = encoded_image(form, mode, frames)
    if content:
        judge(content if is_intact else data.draw(damaged(content, head=64)))


def png(
    width: int,
    height: int,
    *,
    depth: int = 8,
    colour: int = 2,
    more: bytes = b"",
    data: bytes = b"",
) -> bytes:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content))
            + kind
            + content
            + struct.pack(">I", zlib.crc32(kind + content))
        )

    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + more
        + chunk(b"IDAT", data)
        + chunk(b"IEND", b"")
    )


def png_of_text(start: bytes) -> bytes:
    """A PNG with a chunk of `start` and 100 MB of text, compressed."""
    chunk = start + zlib.compress(b"x" * 100_000_000, 9)
    chunk = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return png(16, 16, more=chunk, data=zlib.compress(bytes(16 * 49)))


LARGE_BOMBS = {
    "png of pixels": lambda: png(30_000, 30_000, data=zlib.compress(bytes(200_000_000), 9)),
    "png of text": lambda: png_of_text(b"zTXtRaw profile type exif\0\0"),
    "png of xmp": lambda: png_of_text(b"iTXtXML:com.adobe.xmp\0\1\0\0\0"),
}
"Made in their test: a second each."


@cache
def bombs() -> dict[str, bytes]:
    """Small files that say they are large, or become so."""
    jpeg = bytearray(encoded_image("JPEG", "RGB"))
    at = jpeg.find(b"\xff\xc0")
    jpeg[at + 5 : at + 9] = b"\xff\xff\xff\xff"
    gif = bytearray(encoded_image("GIF", "P"))
    gif[6:10] = b"\xff\xff\xff\xff"
    bmp = bytearray(encoded_image("BMP", "RGB"))
    bmp[18:26] = struct.pack("<ii", 2**31 - 1, -(2**31))
    return {
        "png just below the limit": png(
            13_000, 13_000, colour=0, data=zlib.compress(bytes(1_000_000), 9)[:100]
        ),
        "png that is cut": png(16, 16)[:40],
        "jpeg": bytes(jpeg),
        "gif": bytes(gif),
        "bmp": bytes(bmp),
        "ppm": b"P6 99999 99999 255\n",
        "ppm of digits": b"P3 " + b"9" * 100_000 + b" 1 255\n",
        "jpeg behind a png": encoded_image("PNG", "RGB") + encoded_image("JPEG", "RGB"),
        "zip behind a jpeg": encoded_image("JPEG", "RGB") + b"PK\3\4" + bytes(99),
        "script behind a gif": b"GIF89a=1;alert(1)//" + bytes(30),
        "svg": b"<svg xmlns='http://www.w3.org/2000/svg'><image href='file:///etc/passwd'/></svg>",
    }


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", [*LARGE_BOMBS, *bombs()])
def test_decompression_bomb_is_rejected_or_small(name: str) -> None:
    judge(LARGE_BOMBS[name]() if name in LARGE_BOMBS else bombs()[name])


@pytest.mark.parametrize(
    "form", ["EPS", "ICNS", "ICO", "PCX", "SGI", "DDS", "TGA", "JPEG2000", "PDF"]
)
def test_only_known_image_formats_are_opened(form: str) -> None:
    """Other formats have decoders that the project does not need: EPS starts Ghostscript."""
    content = encoded_image(form, "RGB")
    assert content
    with pytest.raises(DecodeError, match="not an image"):
        decode(content)
