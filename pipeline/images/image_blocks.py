"""Bytes of an image file -> its EXIF and XMP blocks, found by walking the file's structure.

In: the beginning of a file, or all of it. Out: the two blocks as stored, and whether the walk ran
out of bytes. No pixel is decoded, and each step of a walk goes forward, so that hostile lengths
cost nothing.
"""

import struct
from dataclasses import dataclass

EXIF_HEADER = b"Exif\0\0"
XMP_HEADER = b"http://ns.adobe.com/xap/1.0/\0"  # extended XMP has another; it holds nothing we read
XMP_KEYWORD = b"XML:com.adobe.xmp\0"
BARE_MARKERS = {0x01, *range(0xD0, 0xD8)}  # JPEG markers without a length behind them
SCAN, END, APP1 = 0xDA, 0xD9, 0xE1


class UnreadableTag(ValueError):
    """A tag that is present with an impossible value. The message is what was found, for the person
    who repairs it."""


@dataclass(frozen=True, kw_only=True)
class MetadataBlocks:
    """The metadata blocks of an image file."""

    exif: bytes | None = None
    "A TIFF structure: the bytes behind `Exif\\0\\0`, or a whole TIFF file."
    xmp: bytes | None = None
    "An XMP packet; None in a TIFF file, where a tag of the EXIF block holds it."
    truncated: bool = False
    "The bytes ended before the metadata could: read more of the file, if there is more."


def find_metadata(data: bytes, complete: bool) -> MetadataBlocks:
    """The blocks in a JPEG, PNG, WebP or TIFF; none in anything else.

    `data`: from the file's first byte on. `complete`: whether it is the whole file. Raises nothing:
    decoding finds out whether the file is an image.
    """
    if data.startswith(b"\xff\xd8"):
        return _jpeg(data)
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return _png(data)
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return _webp(data)
    if data[:4] in (b"II*\0", b"MM\0*"):  # a TIFF's directories may lie anywhere, mostly at its end
        return MetadataBlocks(exif=data) if complete else MetadataBlocks(truncated=True)
    return MetadataBlocks()


def _jpeg(data: bytes) -> MetadataBlocks:
    exif, xmp, at = None, None, 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            return MetadataBlocks(exif=exif, xmp=xmp)  # damaged: the decoder reports it
        marker = data[at + 1]
        if marker in (SCAN, END):
            return MetadataBlocks(exif=exif, xmp=xmp)
        if marker == 0xFF or marker in BARE_MARKERS:  # 0xFF: a fill byte
            at += 1 if marker == 0xFF else 2
            continue
        end = at + 2 + max(2, int.from_bytes(data[at + 2 : at + 4]))
        if marker == APP1 and end <= len(data):
            content = data[at + 4 : end]
            if exif is None and content.startswith(EXIF_HEADER):
                exif = content[len(EXIF_HEADER) :]
            elif xmp is None and content.startswith(XMP_HEADER):
                xmp = content[len(XMP_HEADER) :]
        at = end
    return MetadataBlocks(exif=exif, xmp=xmp, truncated=True)


def _png(data: bytes) -> MetadataBlocks:
    exif, xmp, at = None, None, 8
    while at + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        content = data[at + 8 : at + 8 + length] if kind in (b"eXIf", b"iTXt") else b""
        complete = len(content) == length
        if kind == b"IEND":
            return MetadataBlocks(exif=exif, xmp=xmp)
        if exif is None and kind == b"eXIf" and complete:
            exif = content.removeprefix(EXIF_HEADER)
        elif xmp is None and complete and content.startswith(XMP_KEYWORD + b"\0"):  # not compressed
            # The packet stands behind a language and a translated keyword.
            xmp = content[len(XMP_KEYWORD) + 2 :].split(b"\0", 2)[-1]
        at += 12 + length
    return MetadataBlocks(exif=exif, xmp=xmp, truncated=True)


def _webp(data: bytes) -> MetadataBlocks:
    exif, xmp, at = None, None, 12
    end = 8 + int.from_bytes(data[4:8], "little")
    while at + 8 <= min(end, len(data)):
        kind, length = struct.unpack_from("<4sI", data, at)
        content = data[at + 8 : at + 8 + length] if kind in (b"EXIF", b"XMP ") else b""
        if exif is None and kind == b"EXIF" and len(content) == length:
            exif = content.removeprefix(EXIF_HEADER)
        elif xmp is None and kind == b"XMP " and len(content) == length:
            xmp = content
        at += 8 + length + length % 2
    return MetadataBlocks(exif=exif, xmp=xmp, truncated=end > len(data))
