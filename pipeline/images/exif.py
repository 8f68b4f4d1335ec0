"""An EXIF block -> the entries of its directories that say where, whither and when a photo was
taken.

In: a TIFF structure of any size and any honesty. Out: raw entries by tag number; nothing is
interpreted here. Only three directories are looked at, each once, and no chain from one to the next
is followed, so that loops have nothing to loop in.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

from pipeline.images.image_blocks import UnreadableTag

XMP_TAG, EXIF_POINTER, GPS_POINTER = 0x02BC, 0x8769, 0x8825
VALUE_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 7: 1, 9: 4, 10: 8}
"Bytes per value, by type; other types hold nothing that we read."
MAX_VALUE_BYTES = 1 << 20
"Bytes of one value; XMP packets of cameras have some kilobytes."
ASCII, RATIONALS = 2, {5: "II", 10: "ii"}


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One tag as it is written."""

    kind: int
    "EXIF's number of its type."
    raw: bytes | None
    """Its values; None where they lie outside the block, are longer than LONGEST, or have a type
    that we do not know."""
    order: str
    "Byte order, as struct writes it."

    def text(self) -> str:
        """Up to the first NUL, stripped; empty where it is no text."""
        return (
            (self.raw or b"").split(b"\0")[0].decode("latin-1").strip()
            if self.kind == ASCII
            else ""
        )

    def integer(self) -> int | None:
        """A single whole number of 1, 2 or 4 bytes."""
        code = {1: "B", 3: "H", 4: "I"}.get(self.kind)
        if code is None or not self.raw:
            return None
        value: int = struct.unpack_from(self.order + code, self.raw)[0]
        return value

    def rationals(self) -> list[tuple[int, int]] | None:
        """Pairs (numerator, denominator); None where they are none."""
        if self.kind not in RATIONALS or self.raw is None:
            return None
        return list(struct.iter_unpack(self.order + RATIONALS[self.kind], self.raw))


Directory = Mapping[int, Entry]


@dataclass(frozen=True, kw_only=True)
class Exif:
    """The directories of an EXIF block; one that is not there is empty."""

    main: Directory = field(default_factory=dict)
    photo: Directory = field(default_factory=dict)
    "Exposure, lens, time."
    gps: Directory = field(default_factory=dict)


def read_exif(block: bytes) -> Exif:
    """The directories of an EXIF block (bytes behind `Exif\\0\\0`) or of a TIFF file.

    Raises UnreadableTag where the main or the GPS directory cannot be followed: then nobody knows
    whether it holds a position. A damaged directory of exposure is taken for an empty one.
    """
    if len(block) < 8:
        return Exif()  # some programs leave an empty block behind
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(block[:4])
    if order is None:
        raise UnreadableTag(f"EXIF that begins with {block[:4]!r}, not with a TIFF header")
    main = _directory(block, order, struct.unpack_from(order + "I", block, 4)[0], "main")
    try:
        photo = _subdirectory(block, order, main, EXIF_POINTER, "photo")
    except UnreadableTag:
        photo = {}
    return Exif(main=main, photo=photo, gps=_subdirectory(block, order, main, GPS_POINTER, "GPS"))


def _subdirectory(block: bytes, order: str, main: Directory, pointer: int, name: str) -> Directory:
    if pointer not in main:
        return {}
    at = main[pointer].integer()
    if at is None:
        raise UnreadableTag(
            f"EXIF whose pointer to its {name} directory is of type {main[pointer].kind}"
        )
    return _directory(block, order, at, name)


def _directory(block: bytes, order: str, at: int, name: str) -> Directory:
    if at + 2 > len(block):
        raise UnreadableTag(
            f"EXIF of {len(block)} bytes whose {name} directory begins at byte {at}"
        )
    [count] = struct.unpack_from(order + "H", block, at)
    if at + 2 + 12 * count > len(block):
        raise UnreadableTag(
            f"EXIF of {len(block)} bytes with {count} entries in its {name} directory at byte {at}"
        )
    entries: dict[int, Entry] = {}
    for start in range(at + 2, at + 2 + 12 * count, 12):
        tag, kind, values = struct.unpack_from(order + "HHI", block, start)
        size = VALUE_BYTES.get(kind, MAX_VALUE_BYTES + 1) * values
        begin = start + 8 if size <= 4 else struct.unpack_from(order + "I", block, start + 8)[0]
        fits = size <= MAX_VALUE_BYTES and begin + size <= len(block)
        # Of a tag that stands there twice the first counts.
        entries.setdefault(
            tag, Entry(kind=kind, raw=block[begin : begin + size] if fits else None, order=order)
        )
    return entries
