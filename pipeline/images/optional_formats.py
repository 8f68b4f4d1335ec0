"""Photos in formats that only an optional library decodes -> PNG: HEIF of phones, raw files.

In: a file's name and bytes. Out: the bytes of a PNG with the photo's tags, or the Rejection that
names the format and what to install; and the metadata blocks of the file. Pixels are not changed:
PNG is lossless.
"""

import io
from importlib.util import find_spec
from typing import Any

from PIL import Image

from pipeline.core.records import Rejection
from pipeline.images.decode import DecodeError, decode_errors
from pipeline.images.exif import read_exif
from pipeline.images.image_blocks import EXIF_HEADER, MetadataBlocks, find_metadata
from pipeline.images.inspect import (
    MAX_PIXELS,
    RAW_SUFFIXES,
    is_image_name,
    undecoded_format,
)
from pipeline.images.tiff_extents import pixels_end

HEIF_SUFFIXES = (".heic", ".heif", ".hif")
EXTRAS = {"heif": (HEIF_SUFFIXES, "pillow_heif"), "raw": (RAW_SUFFIXES, "rawpy")}
"Extra of this project -> the suffixes of its formats, in lower case, and the module it installs."

COMMON_SIGNATURES = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n")
"JPEG and PNG: phones and converters give such files the name of another format."
PHOTO_DIRECTORY, TIME_TAGS = 0x8769, (0x9003, 0x9011, 0x9291)
"EXIF's directory of the photo, and the tags of when it was taken."


def extra_for(path: str) -> str | None:
    """The extra that decodes a file of this name; None where it needs none or there is none."""
    name = path.lower()
    return next((extra for extra, (suffixes, _) in EXTRAS.items() if name.endswith(suffixes)), None)


def is_decodable_name(path: str) -> bool:
    """Whether a file of this name is an image that is decoded here, by the extras installed."""
    extra = extra_for(path)
    return is_image_name(path) or (extra is not None and _is_installed(extra))


def _is_installed(extra: str) -> bool:
    return find_spec(EXTRAS[extra][1]) is not None


def undecodable_format(path: str) -> Rejection | None:
    """The rejection of an image whose format, by its name, is not decoded here, with the extra that
    would decode it; else None.
    """
    rejection, extra = undecoded_format(path), extra_for(path)
    if rejection is None or extra is None:
        return rejection
    if _is_installed(extra):
        return None
    found = f"{rejection.found}, or install the extra `{extra}`: pip install pvda[{extra}]"
    return Rejection(path=path, reason=rejection.reason, found=found)


def convert_optional(path: str, data: bytes) -> bytes | Rejection:
    """The bytes of a file that `decode` reads: those given, or a PNG of its photo.

    A raw file is not left to Pillow, which takes its small preview for the photo.
    """
    extra = extra_for(path)
    if extra is None or data.startswith(COMMON_SIGNATURES):
        return data
    if rejection := undecodable_format(path):
        return rejection
    try:
        with decode_errors(data):
            return _heif_to_png(data) if extra == "heif" else _raw_to_png(data)
    except DecodeError as error:
        return Rejection(path=path, reason=error.reason, found=error.found)


def find_optional_metadata(path: str, data: bytes) -> MetadataBlocks:
    """The metadata blocks of a whole file; of HEIF by the library of its extra.

    None of a damaged file, which decoding refuses.
    """
    if extra_for(path) != "heif" or data.startswith(COMMON_SIGNATURES):
        return find_metadata(data, complete=True)
    import pillow_heif

    try:
        with decode_errors(data):
            info = pillow_heif.open_heif(io.BytesIO(data)).info  # decodes no pixel
    except DecodeError:
        return MetadataBlocks()
    exif = info.get("exif")
    return MetadataBlocks(
        exif=exif.removeprefix(EXIF_HEADER) if exif else None, xmp=info.get("xmp") or None
    )


def _heif_to_png(data: bytes) -> bytes:
    import pillow_heif

    opened = pillow_heif.open_heif(io.BytesIO(data), convert_hdr_to_8bit=True)
    _check_size(*opened.size)
    image = opened.to_pillow()  # upright: libheif applies the orientation
    return _png(image.convert("RGB"), image.getexif().tobytes() if image.getexif() else None)


def _raw_to_png(data: bytes) -> bytes:
    import rawpy

    if (end := pixels_end(data)) > len(data):
        found = f"{len(data)} bytes of a raw file whose pixels end at {end}"
        raise DecodeError("truncated image", found)
    with rawpy.imread(io.BytesIO(data)) as raw:
        _check_size(raw.sizes.width, raw.sizes.height)
        pixels_HW3 = raw.postprocess(use_camera_wb=True)  # upright
    return _png(Image.fromarray(pixels_HW3), _time_block(data))


def _time_block(data: bytes) -> bytes | None:
    """An EXIF block with the time of a raw photo, whose own block is the whole file."""
    photo, block = read_exif(find_metadata(data, complete=True).exif or b"").photo, Image.Exif()
    times = {tag: photo[tag].text() for tag in TIME_TAGS if tag in photo}
    block.get_ifd(PHOTO_DIRECTORY).update(times)
    return block.tobytes() if times else None


def _check_size(width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        raise DecodeError("too many pixels", f"{width} x {height} pixels, expected {MAX_PIXELS:,}")


def _png(image: Any, exif: bytes | None) -> bytes:
    stream = io.BytesIO()
    image.save(stream, "PNG", compress_level=1, **({"exif": exif} if exif else {}))
    return stream.getvalue()
