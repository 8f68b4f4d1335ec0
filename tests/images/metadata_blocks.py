"""EXIF and XMP blocks for tests: made by Pillow, or by hand where no library writes them."""

import struct
from collections.abc import Sequence
from typing import Any

from PIL import Image

from pipeline.images.camera_tags import CameraTags, read_tags
from pipeline.images.exif import RATIONALS
from pipeline.images.image_blocks import EXIF_HEADER, MetadataBlocks

PARIS = {1: "N", 2: (48.0, 51.0, 29.6), 3: "E", 4: (2.0, 17.0, 40.2)}
"48 + 51 / 60 + 29.6 / 3600 = 48.8582222; 2 + 17 / 60 + 40.2 / 3600 = 2.2945"
DJI = (
    'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:AbsoluteAltitude="+172.40" '
    'drone-dji:RelativeAltitude="+50.10" drone-dji:GimbalYawDegree="-90.00" '
    'drone-dji:FlightYawDegree="+12.00" drone-dji:GimbalPitchDegree="-60.50"'
)
RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"


def exif(gps: dict[int, Any] | None = None, photo: dict[int, Any] | None = None) -> bytes:
    """An EXIF block as Pillow writes it."""
    made = Image.Exif()
    for pointer, tags in ((0x8825, gps), (0x8769, photo)):
        if tags:
            made.get_ifd(pointer).update(tags)
    return made.tobytes().removeprefix(EXIF_HEADER)


def packet(attributes: str = "", elements: str = "", before: str = "") -> bytes:
    """An XMP packet of one description."""
    return (
        f'{before}<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="{RDF}">'
        f'<rdf:Description rdf:about="" {attributes}>{elements}</rdf:Description>'
        "</rdf:RDF></x:xmpmeta>"
    ).encode()


def gps_block(
    entries: dict[int, tuple[int, int, bytes]], pointer: int = 4, count: int = 1
) -> bytes:
    """An EXIF block by hand: header, main directory at 8, GPS at 26, its values behind it.

    `entries`: by tag the type, the number of values and their bytes; `pointer`, `count`: type and
    number of values of the entry that leads to the directory.
    """
    main = struct.pack("<HHHIII", 1, 0x8825, pointer, count, 26 if count else 0, 0)
    begin = 26 + 2 + 12 * len(entries) + 4
    rows, values = b"", b""
    for tag, (kind, number, raw) in sorted(entries.items()):
        rows += struct.pack("<HHI", tag, kind, number)
        if len(raw) <= 4:
            rows += raw.ljust(4, b"\0")
        else:
            rows += struct.pack("<I", begin + len(values))
            values += raw
    directory = struct.pack("<H", len(entries)) + rows + bytes(4)
    return b"II*\0" + struct.pack("<I", 8) + main + directory + values


def angle(parts: Sequence[tuple[int, int]], kind: int = 5) -> tuple[int, int, bytes]:
    """Fractions as an entry of `gps_block`."""
    return kind, len(parts), b"".join(struct.pack("<" + RATIONALS[kind], *part) for part in parts)


def position_block(
    lat: Sequence[tuple[int, int]], lon: Sequence[tuple[int, int]], letters: str = "NE", **more: int
) -> bytes:
    """An EXIF block of a position; a blank letter is left empty."""
    north, east = (letter.strip().encode() + b"\0" for letter in letters)
    return gps_block({1: (2, 2, north), 2: angle(lat), 3: (2, 2, east), 4: angle(lon)}, **more)


def tags_of(gps: dict[int, Any] | None = None, xmp: bytes | None = None, **more: Any) -> CameraTags:
    return read_tags(MetadataBlocks(exif=exif(gps, **more), xmp=xmp))
