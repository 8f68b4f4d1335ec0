"""The bytes of a file -> the size of the image that they hold, in microseconds: from its structure,
not decoded.

In: the encoded bytes, all of them. Out: width and height as the image stands upright, or why it is
refused.
"""

import io
from dataclasses import dataclass

import simplejpeg
from PIL import Image

from pipeline.core.records import Rejection
from pipeline.images.decode import (
    PILLOW_FORMATS,
    DecodeError,
    decode,
    decode_errors,
    orientation_of,
)

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")
"Of files that are taken for images, in lower case; upper case is valid too."
UNDECODED_SUFFIXES = (
    ".heic", ".heif", ".hif", ".avif", ".jxl", ".jp2", ".j2k", ".jpx", ".gif", ".psd", ".exr",
    ".dng", ".raw", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".orf", ".rw2", ".raf", ".pef", ".3fr",
)  # fmt: skip
"Of images in formats that are not decoded here, in lower case."
RAW_SUFFIXES = UNDECODED_SUFFIXES[UNDECODED_SUFFIXES.index(".dng") :]
"Of raw images, which many cameras write beside a JPEG of the same photo."
MAX_PIXELS = 178_956_970
"""Where Pillow sees a decompression bomb: twice what 24 bits a pixel make of a quarter of a GiB.
Larger images decode refuses."""
MIN_SIDE, MAX_SIDE = 8, 65_535
"""Pixels. Smaller images are a web page's spacers and counters, larger ones a mosaic's, which a
source cuts into tiles."""
MAX_RATIO = 100
"Longer side over shorter one: a strip, squeezed into a square, shows no location."
FIRST_TRANSPOSED = 5
"EXIF orientations from this one on turn an image so that its width becomes its height."
PNG_METADATA_KEYWORDS = (b"Raw profile type exif\0", b"XML:com.adobe.xmp\0")
"Of the text chunks that may hold an orientation."


def is_image_name(name: str) -> bool:
    """Whether a file is taken for an image, by its name."""
    return name.lower().endswith(IMAGE_SUFFIXES)


def is_undecoded_image_name(name: str) -> bool:
    """Whether a file is an image of a format that is not decoded here, by its name."""
    return name.lower().endswith(UNDECODED_SUFFIXES)


def undecoded_format(path: str) -> Rejection | None:
    """The rejection of an image whose format, by its name, is not decoded here; else None."""
    if not is_undecoded_image_name(path):
        return None
    name = path.rsplit("/", 1)[-1]
    ending = name.rpartition(".")[2]
    return Rejection(
        path=path,
        reason=f"format not decoded (.{ending.lower()})",
        found=f"{name}: {ending.upper()} is not decoded; convert it to JPEG, PNG or TIFF",
    )


def inspect(data: bytes, most_pixels: int = MAX_PIXELS) -> tuple[int, int]:
    """Encoded image -> (width, height), upright as its EXIF orientation says; JPEG, PNG and WebP
    without decoding.

    It refuses for decode's reasons (`empty file`, `not an image`, `damaged image`, `too many
    pixels`), and also for `truncated image`, where the end is missing, and `absurd dimensions`. An
    accepted image may still not decode: flipped or overwritten bytes within the compressed pixels
    are not seen, nor a hole that was filled so that the end is where it belongs. CMYK JPEG, TIFF,
    BMP, GIF and all others are decoded, so every fault of theirs is seen; JPEG, PNG and WebP of
    more than `most_pixels` never are.

    Raises DecodeError.
    """
    with decode_errors(data):
        if data.startswith(b"\xff\xd8\xff"):
            size = _jpeg(data, most_pixels)
        elif data.startswith(b"\x89PNG\r\n\x1a\n"):
            size = _png(data, most_pixels)
        elif data.startswith(b"RIFF") and data[8:12] == b"WEBP":
            size = _webp(data)
        else:
            size = _size_by_decoding(data)
    _check_dimensions(*size, most_pixels)
    return size


def _check_dimensions(width: int, height: int, most_pixels: int) -> None:
    short, long = sorted((width, height))
    if width * height > most_pixels:
        raise DecodeError(
            "too many pixels", f"{width} x {height}, expected at most {most_pixels} pixels"
        )
    if short < MIN_SIDE or long > MAX_SIDE or long > MAX_RATIO * short:
        raise DecodeError(
            "absurd dimensions",
            f"{width} x {height}, expected sides of {MIN_SIDE} to {MAX_SIDE} pixels, one at most "
            f"{MAX_RATIO} times the other",
        )


def _size_by_decoding(data: bytes) -> tuple[int, int]:
    height, width = decode(data).shape[:2]
    return width, height


def _upright_size(data: bytes) -> tuple[int, int]:
    """The size of an image that may have an orientation, read as decode reads it."""
    with Image.open(io.BytesIO(data), formats=PILLOW_FORMATS) as opened:  # reads the header only
        width, height = opened.size
        return (height, width) if orientation_of(opened) >= FIRST_TRANSPOSED else (width, height)


@dataclass(frozen=True, kw_only=True)
class _JpegHeader:
    width: int
    height: int
    colours: int
    has_metadata: bool
    "Whether there is an APP1 segment (EXIF, XMP)."
    scan: int
    "Where the first scan begins."


def _jpeg(data: bytes, most_pixels: int) -> tuple[int, int]:
    header = _jpeg_header(data)
    _check_dimensions(header.width, header.height, most_pixels)
    if header.colours not in (1, 3):  # decode leaves these to Pillow, which tolerates a missing end
        return _size_by_decoding(data)
    # The end marker cannot occur within compressed pixels. It may stand far from the file's end:
    # cameras append previews, depth maps and padding. A thumbnail in the header has one too, hence
    # the search from the first scan on.
    if data.rfind(b"\xff\xd9", header.scan) < 0:  # from the end: it is mostly there
        raise DecodeError("truncated image", f"{len(data)} bytes of JPEG without an end marker")
    simplejpeg.decode_jpeg_header(data)  # libjpeg checks tables and colours
    return _upright_size(data) if header.has_metadata else (header.width, header.height)


def _jpeg_header(data: bytes) -> _JpegHeader:
    """The segments up to the first scan. Bytes between segments are skipped, as libjpeg does."""
    at, end = 2, len(data)
    width = height = colours = -1
    has_metadata = False
    while 0 <= at < end - 3:
        if data[at] != 0xFF:
            at = data.find(b"\xff", at)
            continue
        kind = data[at + 1]
        if kind == 0xFF:
            at += 1
            continue
        if kind == 0 or kind == 1 or 0xD0 <= kind <= 0xD8:  # without a length
            at += 2
            continue
        length = (data[at + 2] << 8) + data[at + 3]
        if kind == 0xDA:
            if colours < 0:
                found = f"{end} bytes of JPEG whose pixels come before their size"
                raise DecodeError("damaged image", found)
            return _JpegHeader(
                width=width,
                height=height,
                colours=colours,
                has_metadata=has_metadata,
                scan=at + 2 + length,
            )
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC) and at + 9 < end:
            height, width = (data[at + 5] << 8) + data[at + 6], (data[at + 7] << 8) + data[at + 8]
            colours = data[at + 9]
        elif kind == 0xE1:
            has_metadata = True
        elif kind == 0xD9:
            raise DecodeError("damaged image", f"{end} bytes of JPEG that end before any pixel")
        at += 2 + length
    raise DecodeError("truncated image", f"{end} bytes of JPEG that end within the header")


def _png(data: bytes, most_pixels: int) -> tuple[int, int]:
    at, has_metadata, pixels, end = 8, False, False, len(data)
    size: tuple[int, int] | None = None
    while at + 12 <= end:
        length, kind = int.from_bytes(data[at : at + 4]), data[at + 4 : at + 8]
        if kind == b"IEND":
            break
        if kind == b"IHDR":
            size = int.from_bytes(data[at + 8 : at + 12]), int.from_bytes(data[at + 12 : at + 16])
            _check_dimensions(*size, most_pixels)
        elif kind == b"eXIf" or (
            kind in (b"iTXt", b"zTXt", b"tEXt") and data.startswith(PNG_METADATA_KEYWORDS, at + 8)
        ):
            has_metadata = True
        pixels |= kind == b"IDAT"
        at += 12 + length
    else:
        raise DecodeError("truncated image", f"{end} bytes of PNG without an end chunk")
    if size is None or not pixels:
        missing = "pixels" if size else "a header"
        raise DecodeError("damaged image", f"{end} bytes of PNG without {missing}")
    return _upright_size(data) if has_metadata else size


def _webp(data: bytes) -> tuple[int, int]:
    stated = 8 + int.from_bytes(data[4:8], "little")
    if len(data) < stated:
        found = f"{len(data)} bytes of WebP that states a size of {stated}"
        raise DecodeError("truncated image", found)
    return _upright_size(data)
