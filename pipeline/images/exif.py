"""An EXIF block -> the entries of its directories that hold position, heading and time of a photo.

In: a TIFF structure of any size, damaged or hostile. Out: raw entries by tag number; nothing is
interpreted here. Only three directories are read, each once, and no chain from one to the next is
followed, so that loops have nothing to loop in. A directory that cannot be read is empty and named
in `unreadable`: it costs the tags in it and no others.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

from pipeline.images.image_blocks import UnreadableTag

XMP_TAG, EXIF_POINTER, GPS_POINTER = 0x02BC, 0x8769, 0x8825
INTEGERS = {1: "B", 3: "H", 4: "I", 6: "b", 8: "h", 9: "i", 13: "I"}
"Types of whole numbers [TIFF 6.0; 13, IFD: TIFF Technical Note 1], as struct writes them."
RATIONALS, FLOATS = {5: "II", 10: "ii"}, {11: "f", 12: "d"}
TEXTS = {1, 2, 7, 129}
"Types of text: ASCII, UTF-8 [EXIF 3.0], and the bytes that some programs write instead."
NUMBERS = INTEGERS | RATIONALS | FLOATS
VALUE_BYTES = {kind: struct.calcsize(f"<{code}") for kind, code in NUMBERS.items()}
VALUE_BYTES |= dict.fromkeys(TEXTS - {1}, 1)
"Bytes per value, by type; other types hold nothing that we read."
MAX_VALUE_BYTES = 1 << 20
"Of one entry; XMP packets of cameras have some kilobytes."
MAX_NUMBERS_BYTES = 24
"Three fractions: degrees, minutes and seconds."


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One tag as stored."""

    kind: int
    "EXIF's number of its type."
    raw: bytes | None
    """Its values; None if they lie outside the block, are longer than MAX_VALUE_BYTES, or have an
    unknown type."""
    order: str
    "Byte order, as struct writes it."

    @property
    def unfilled(self) -> bool:
        """Whether it has no value, or only zeros and blanks: 0/0 and 0/1 alike."""
        if self.raw is None:
            return False
        parts = self.rationals()
        if parts is not None:
            return all(numerator == 0 for numerator, _ in parts)
        return not self.raw.strip(b"\0 ")

    def text(self) -> str:
        """Up to the first NUL, stripped; empty if it is not text."""
        if self.kind not in TEXTS:
            return ""
        return (self.raw or b"").split(b"\0")[0].decode("latin-1").strip()

    def integer(self) -> int | None:
        """The first of its whole numbers; None if it has none."""
        code = INTEGERS.get(self.kind)
        if code is None or not self.raw:
            return None
        value: int = struct.unpack_from(self.order + code, self.raw)[0]
        return value

    def rationals(self) -> list[tuple[float, int]] | None:
        """Its numbers as pairs (numerator, denominator), the latter 1 unless they are fractions;
        None if it holds no numbers."""
        code = NUMBERS.get(self.kind)
        if code is None or self.raw is None or len(self.raw) > MAX_NUMBERS_BYTES:
            return None
        values = list(struct.iter_unpack(self.order + code, self.raw))
        return values if self.kind in RATIONALS else [(value, 1) for [value] in values]


Directory = Mapping[int, Entry]


@dataclass(frozen=True, kw_only=True)
class Exif:
    """The directories of an EXIF block; an absent or unreadable one is empty."""

    main: Directory = field(default_factory=dict)
    photo: Directory = field(default_factory=dict)
    "Exposure, lens, time."
    gps: Directory = field(default_factory=dict)
    unreadable: tuple[str, ...] = ()
    "What cannot be read, as sentences; a damaged directory of exposure is not worth one."


def read_exif(block: bytes) -> Exif:
    """The directories of an EXIF block (bytes behind `Exif\\0\\0`) or of a TIFF file."""
    if len(block) < 8:
        return Exif()  # some programs leave an empty block behind
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(block[:4])
    if order is None:
        found = f"EXIF that begins with {block[:4]!r}, not with a TIFF header"
        return Exif(unreadable=(found,))
    unreadable: list[str] = []

    def read(at: int, name: str) -> Directory:
        try:
            return _directory(block, order, at, name)
        except UnreadableTag as error:
            if name != "photo":
                unreadable.append(str(error))
            return {}

    main = read(struct.unpack_from(order + "I", block, 4)[0], "main")
    below: dict[str, Directory] = {"photo": {}, "GPS": {}}
    for name, pointer in (("photo", EXIF_POINTER), ("GPS", GPS_POINTER)):
        entry = main.get(pointer)
        if entry is None or entry.unfilled:
            continue
        at = entry.integer()
        if at is not None:
            below[name] = read(at, name)
        elif name == "GPS":
            unreadable.append(f"EXIF whose pointer to its GPS directory is of type {entry.kind}")
    return Exif(main=main, photo=below["photo"], gps=below["GPS"], unreadable=tuple(unreadable))


def _directory(block: bytes, order: str, at: int, name: str) -> Directory:
    if at + 2 > len(block):
        found = f"EXIF of {len(block)} bytes whose {name} directory begins at byte {at}"
        raise UnreadableTag(found)
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
        # Of a tag that is there twice the first counts.
        raw = block[begin : begin + size] if fits else None
        entries.setdefault(tag, Entry(kind=kind, raw=raw, order=order))
    return entries
