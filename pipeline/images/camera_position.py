"""The position of a camera: EXIF's and XMP's statements of it, read and compared.

In: the GPS directory of an EXIF block, the properties of an XMP packet. Out: latitude and
longitude, WGS84, or None if the camera had no fix. A statement that cannot be read yields to
another one; two that contradict each other are an error, because a wrong position is worse than
none.
"""

import math
import re
from collections.abc import Mapping
from functools import partial

import numpy as np

from pipeline.core.geo import haversine_m
from pipeline.images.exif import Directory
from pipeline.images.image_blocks import UnreadableTag

Position = tuple[float, float]
"Latitude and longitude, degrees."
LATITUDE_REF, LATITUDE, LONGITUDE_REF, LONGITUDE, DATUM = 1, 2, 3, 4, 18
XMP_POSITIONS = (
    ("GpsLatitude", "GpsLongitude"),
    ("GpsLatitude", "GpsLongtitude"),  # so spelt by much firmware
    ("Latitude", "Longitude"),  # old DJI; Skydio
    (
        "GPSLatitude",
        "GPSLongitude",
    ),  # EXIF's, copied into XMP: `33,51.407S` [XMP part 2, GPSCoordinate]
)
XMP_ANGLE = re.compile(r"(\d{1,3}),(\d{1,2}(?:\.\d{1,12})?)(?:,(\d{1,2}(?:\.\d{1,12})?))?([NSEW])")
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d{1,3})?", re.ASCII)
"A number in one form only: alternatives would take time that grows with its square."
MAX_APART_M = 50.0
"""Between two statements of one position. EXIF in whole seconds, cut off, errs by up to 44 m; a
lost sign, or the EXIF of another photo, by more."""
WGS84_DATUMS = (
    "WGS84", "NAD83", "ETRS89", "GDA94", "GDA2020", "JGD2000", "JGD2011", "CGCS2000", "SIRGAS2000",
    "GRS80", "ITRF", "PZ90",
)  # fmt: skip
"Within two metres of WGS84, which cameras do not reach."
OTHER_DATUMS = {"TOKYO": 4301, "NAD27": 4267, "ED50": 4230}
"EPSG code by the name in GPSMapDatum; their positions are 100 to 500 m off in WGS84."


def read_position(gps: Directory, xmp: Mapping[str, str]) -> tuple[Position | None, list[str]]:
    """The camera's position, and the statements of it that could not be read while another could.

    None: no statement, or no fix, which cameras write as zeros, 0/0 or empty values. Raises
    UnreadableTag if statements contradict each other, or the only ones cannot be right.
    """
    stated: list[tuple[str, Position]] = []
    unreadable: list[str] = []
    readers = [("EXIF", partial(_exif_position, gps))]
    readers += [("XMP", partial(_xmp_position, xmp, pair)) for pair in XMP_POSITIONS]
    for name, read in readers:
        try:
            position = read()
        except UnreadableTag as error:
            unreadable.append(str(error))
        else:
            stated += [(name, position)] if position is not None else []
    if not stated:
        half = _half_xmp_position(xmp)
        unreadable += [half] if half else []
        if unreadable:
            raise UnreadableTag("; ".join(dict.fromkeys(unreadable)))
        return None, []
    _check_agreement(stated)
    return stated[0][1], list(dict.fromkeys(unreadable))


def validate_position(lat: float, lon: float, found: str) -> Position | None:
    """A position on the globe, or None at exactly 0, 0, which stands for no fix.

    Raises UnreadableTag, with `found` in its message, for anything else.
    """
    if not (abs(lat) <= 90 and abs(lon) <= 180):  # false for NaN as well
        raise UnreadableTag(f"{found}: latitude {lat}, longitude {lon}")
    return None if lat == 0 and lon == 0 else (lat, lon)


def parse_number(text: str) -> float | None:
    """A finite number as cameras write it, `+50.10`; None if the text is something else."""
    value = float(text) if NUMBER.fullmatch(text.strip()) else math.nan
    return value if math.isfinite(value) else None


def _check_agreement(stated: list[tuple[str, Position]]) -> None:
    (name, first), *others = stated
    for other_name, other in others:
        metres = float(haversine_m(np.array(first), np.array(other)))
        if metres > MAX_APART_M:
            raise UnreadableTag(
                f"two positions: {name} has latitude {first[0]:.7f}, longitude {first[1]:.7f} and "
                f"{other_name} {other[0]:.7f}, {other[1]:.7f}, {metres:,.0f} m apart"
            )


def _exif_position(gps: Directory) -> Position | None:
    angles = [gps[tag] for tag in (LATITUDE, LONGITUDE) if tag in gps]
    if all(angle.unfilled for angle in angles):
        return None  # before their letters, which then are often missing
    lat = _signed(gps, LATITUDE, LATITUDE_REF, "NS", "GPSLatitude")
    lon = _signed(gps, LONGITUDE, LONGITUDE_REF, "EW", "GPSLongitude")
    position = validate_position(lat, lon, "GPS of the EXIF")
    return position and _to_wgs84(position, gps[DATUM].text() if DATUM in gps else "")


def _signed(gps: Directory, tag: int, ref: int, letters: str, name: str) -> float:
    """Degrees with their sign, from the letter of the hemisphere or from the number itself."""
    value = _angle(gps, tag, name)
    text = gps[ref].text() if ref in gps else ""
    letter = text[:1].upper()
    if value < 0 and letter in ("", letters[1]):
        return value
    if value < 0 and letter == letters[0]:
        raise UnreadableTag(f"{name} is {value} and {name}Ref {text!r}")
    if letter not in tuple(letters):
        raise UnreadableTag(f"{name}Ref is {text!r}, not {letters[0]} or {letters[1]}")
    return value if letter == letters[0] else -value


def _angle(gps: Directory, tag: int, name: str) -> float:
    """Degrees, minutes and seconds -> degrees.

    Minutes and seconds, or seconds alone, may be absent behind a part with a fraction.
    """
    if tag not in gps:
        raise UnreadableTag(f"a position without {name}")
    parts = gps[tag].rationals() or []
    if not 1 <= len(parts) <= 3:
        raise UnreadableTag(f"{name} of EXIF type {gps[tag].kind} that is not three rationals")
    found = f"{name} {' '.join(f'{above}/{below}' for above, below in parts)}"
    while len(parts) > 1 and parts[-1] == (0, 0):
        parts = parts[:-1]
    above, below = parts[-1]
    if len(parts) < 3 and below <= 1 and float(above).is_integer():
        raise UnreadableTag(f"{found}, not three rationals")
    if any(below == 0 for _, below in parts):
        raise UnreadableTag(found)
    degrees, minutes, seconds = [above / below for above, below in parts] + [0.0] * (3 - len(parts))
    if not (abs(minutes) <= 60 and abs(seconds) <= 60):  # 60 comes of rounding; false for NaN
        raise UnreadableTag(found)
    value = abs(degrees) + abs(minutes) / 60 + abs(seconds) / 3600
    return -value if min(degrees, minutes, seconds) < 0 else value


def _to_wgs84(position: Position, datum: str) -> Position:
    name = re.sub(r"[^A-Z0-9]", "", datum.upper())
    if not name or name.startswith(WGS84_DATUMS):
        return position
    code = next((code for other, code in OTHER_DATUMS.items() if name.startswith(other)), None)
    if code is None:
        raise UnreadableTag(f"GPSMapDatum is {datum!r}, expected WGS-84")
    from pyproj import Transformer  # here: a photo in a hundred thousand needs it

    lat, lon = Transformer.from_crs(code, 4326).transform(*position)
    return float(lat), float(lon)


def _xmp_position(xmp: Mapping[str, str], pair: tuple[str, str]) -> Position | None:
    if not all(xmp.get(name) for name in pair):
        return None
    lat, lon = (_xmp_angle(xmp[name], xmp.get(f"{name}Ref", "")) for name in pair)
    if lat is None or lon is None:
        letters = (xmp.get(f"{name}Ref", "") for name in pair)
        found = (f"{name} {xmp[name]}" for name in pair)
        stated = zip(found, letters, strict=True)
        raise UnreadableTag(", ".join(" ".join(both).strip() for both in stated))
    return validate_position(lat, lon, "GPS of the XMP")


def _xmp_angle(text: str, letter: str) -> float | None:
    """Decimal degrees, or `DDD,MM,SSk` and `DDD,MM.mmk` with the hemisphere's letter k.

    `letter`: that of a property of its own, as some programs write it; empty if there is none.
    """
    match = XMP_ANGLE.fullmatch(text.strip())
    if match is None:
        value, west = parse_number(text), letter[:1].upper() in ("S", "W")
        if value is None or (value < 0 and letter and not west):
            return None
        return -abs(value) if west else value
    degrees, minutes, seconds = (float(part or 0) for part in match.groups()[:3])
    if max(minutes, seconds) > 60:
        return None
    value = degrees + minutes / 60 + seconds / 3600
    return -value if match[4] in "SW" else value


def _half_xmp_position(xmp: Mapping[str, str]) -> str | None:
    """The sentence about a latitude without its longitude, or the other way round."""
    half = [name for pair in XMP_POSITIONS for name in pair if xmp.get(name)]
    complete = any(all(xmp.get(name) for name in pair) for pair in XMP_POSITIONS)
    return f"{half[0]} {xmp[half[0]]} without its other half" if half and not complete else None
