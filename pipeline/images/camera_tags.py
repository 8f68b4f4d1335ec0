"""What a camera says of a photo: bytes of the image's beginning -> position, heights, heading,
pitch, time.

In: bytes. Out: CameraTags. Pure, and bounded in time and memory whatever the bytes are. A position
that is there and cannot be right is an error, since a wrong position is worse than none; any other
tag that makes no sense is taken for absent.

EXIF names and units: CIPA DC-008. XMP names: DJI's list for the Zenmuse P1 and Mavic 3
(`drone-dji`), which Autel took over; Parrot's and Skydio's own beside them. Pix4D's Camera:Yaw and
Camera:Pitch are left alone: makers disagree on where their pitch has its zero.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime

from pipeline.images.exif import XMP_TAG, Directory, read_exif
from pipeline.images.image_blocks import MetadataBlocks, UnreadableTag
from pipeline.images.xmp import read_xmp

(
    LATITUDE_REF,
    LATITUDE,
    LONGITUDE_REF,
    LONGITUDE,
    ALTITUDE_REF,
    ALTITUDE,
    DIRECTION_REF,
    DIRECTION,
) = (
    1,
    2,
    3,
    4,
    5,
    6,
    16,
    17,
)
TAKEN, TAKEN_OFFSET, TAKEN_FRACTION = 0x9003, 0x9011, 0x9291
XMP_POSITIONS = (
    ("GpsLatitude", "GpsLongitude"),
    ("GpsLatitude", "GpsLongtitude"),  # so spelt by much firmware
    ("Latitude", "Longitude"),  # old DJI; Skydio
)
XMP_HEIGHT = ("AboveGroundAltitude", "RelativeAltitude")
XMP_HEADING = ("GimbalYawDegree", "CameraYawDegree", "CameraOrientationNED.Yaw")
XMP_BODY_HEADING = ("FlightYawDegree", "DroneYawDegree")
XMP_PITCH = ("GimbalPitchDegree", "CameraPitchDegree", "CameraOrientationNED.Pitch")
GIMBAL_OVERSHOOT_DEG = 1.0  # degrees by which gimbals overshoot straight down: -90.1 is common
NUMBER = re.compile(
    r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d{1,3})?", re.ASCII
)  # in one way only: a square of time else


@dataclass(frozen=True, kw_only=True)
class CameraTags:
    """Where the camera was and how it looked; None is unknown."""

    position: tuple[float, float] | None = None
    "The camera's own latitude and longitude, degrees, WGS84. Not the place that it looks at."
    height_m: float | None = None
    """Above the ground, or, as nearly all cameras know nothing else, above the point of take-off;
    metres."""
    sea_level_m: float | None = None
    "Altitude above sea level or ellipsoid (cameras do not say which), metres."
    heading_deg: float | None = None
    "Of the camera, else of the aircraft; clockwise from true north, from 0 to below 360."
    pitch_deg: float | None = None
    "Of the optical axis, from -90 (straight down) to 90."
    taken_at: str | None = None
    "ISO 8601; without an offset the camera's own clock."


def read_tags(blocks: MetadataBlocks) -> CameraTags:
    """The tags of an image whose metadata blocks these are.

    EXIF's position is taken before XMP's; XMP's gimbal before EXIF's direction, and that before the
    aircraft's heading. Exactly 0, 0 is what cameras write without a fix: no position. Raises
    UnreadableTag.
    """
    exif = read_exif(blocks.exif or b"")
    packet = blocks.xmp or (exif.main[XMP_TAG].raw if XMP_TAG in exif.main else None)
    xmp = read_xmp(packet) if packet else {}
    heading = _first_number(xmp, XMP_HEADING)
    for other in (_direction(exif.gps), _first_number(xmp, XMP_BODY_HEADING)):
        heading = other if heading is None else heading
    pitch = _first_number(xmp, XMP_PITCH)
    if pitch is not None:
        pitch = max(-90.0, min(90.0, pitch)) if abs(pitch) <= 90 + GIMBAL_OVERSHOOT_DEG else None
    sea_level = _altitude(exif.gps)
    return CameraTags(
        position=_exif_position(exif.gps) or _xmp_position(xmp),
        height_m=_first_number(xmp, XMP_HEIGHT),
        sea_level_m=_first_number(xmp, ("AbsoluteAltitude",)) if sea_level is None else sea_level,
        heading_deg=None if heading is None else heading % 360,
        pitch_deg=pitch,
        taken_at=_taken_at(exif.photo),
    )


def validate_position(lat: float, lon: float, said: str) -> tuple[float, float] | None:
    """A position on the globe, or None at exactly 0, 0, which stands for no fix.

    Raises UnreadableTag, with `said` in its message, for anything else.
    """
    if not (abs(lat) <= 90 and abs(lon) <= 180):  # false for NaN as well
        raise UnreadableTag(f"{said}: latitude {lat}, longitude {lon}")
    return None if lat == 0 and lon == 0 else (lat, lon)


def parse_number(text: str) -> float | None:
    """A finite number as cameras write it, `+50.10`; None where the text is something else."""
    value = float(text) if NUMBER.fullmatch(text.strip()) else math.nan
    return value if math.isfinite(value) else None


def _exif_position(gps: Directory) -> tuple[float, float] | None:
    if LATITUDE not in gps and LONGITUDE not in gps:
        return None
    lat, lon = _angle(gps, LATITUDE, "GPSLatitude"), _angle(gps, LONGITUDE, "GPSLongitude")
    if lat == 0 and lon == 0:
        return None  # before their refs, which then are often missing
    signed = [
        magnitude * _sign(gps, ref, letters, name)
        for magnitude, ref, letters, name in (
            (lat, LATITUDE_REF, "NS", "GPSLatitudeRef"),
            (lon, LONGITUDE_REF, "EW", "GPSLongitudeRef"),
        )
    ]
    return validate_position(signed[0], signed[1], "GPS of the EXIF")


def _angle(gps: Directory, tag: int, name: str) -> float:
    """Degrees, minutes, seconds -> degrees from 0 on."""
    if tag not in gps:
        raise UnreadableTag(f"a position without {name}")
    parts = gps[tag].rationals()
    if parts is None or len(parts) != 3:
        raise UnreadableTag(f"{name} of EXIF type {gps[tag].kind} that is not three rationals")
    said = f"{name} {' '.join(f'{above}/{below}' for above, below in parts)}"
    if any(below == 0 for _, below in parts):
        raise UnreadableTag(said)
    degrees, minutes, seconds = (above / below for above, below in parts)
    if degrees < 0 or not (0 <= minutes <= 60 and 0 <= seconds <= 60):  # 60 comes of rounding
        raise UnreadableTag(said)
    return degrees + minutes / 60 + seconds / 3600


def _sign(gps: Directory, tag: int, letters: str, name: str) -> int:
    said = gps[tag].text().upper() if tag in gps else ""
    if said[:1] not in tuple(letters):
        raise UnreadableTag(f"{name} is {said!r}, not {letters[0]} or {letters[1]}")
    return 1 if said[0] == letters[0] else -1


def _xmp_position(xmp: Mapping[str, str]) -> tuple[float, float] | None:
    pair = next((pair for pair in XMP_POSITIONS if all(xmp.get(name) for name in pair)), None)
    if pair is None:
        half = [name for pair in XMP_POSITIONS for name in pair if xmp.get(name)]
        if half:
            raise UnreadableTag(f"{half[0]} {xmp[half[0]]} without its other half")
        return None
    said = ", ".join(f"{name} {xmp[name]}" for name in pair)
    lat, lon = (parse_number(xmp[name]) for name in pair)
    if lat is None or lon is None:
        raise UnreadableTag(said)
    return validate_position(lat, lon, "GPS of the XMP")


def _first_number(xmp: Mapping[str, str], names: tuple[str, ...]) -> float | None:
    """The first of these properties that is a number."""
    return next(
        (value for name in names if (value := parse_number(xmp.get(name, ""))) is not None), None
    )


def _first_rational(gps: Directory, tag: int) -> float | None:
    parts = gps[tag].rationals() if tag in gps else None
    return parts[0][0] / parts[0][1] if parts and parts[0][1] else None


def _altitude(gps: Directory) -> float | None:
    value = _first_rational(gps, ALTITUDE)
    below = ALTITUDE_REF in gps and gps[ALTITUDE_REF].integer() in (
        1,
        3,
    )  # 2 and 3: EXIF 3.0, of the ellipsoid
    return -value if value is not None and below else value


def _direction(gps: Directory) -> float | None:
    """Degrees from true north; a magnetic direction is none, as its declination is not known here."""
    magnetic = DIRECTION_REF in gps and gps[DIRECTION_REF].text().upper() == "M"
    value = _first_rational(gps, DIRECTION)
    return value if value is not None and not magnetic and 0 <= value <= 360 else None


def _taken_at(photo: Directory) -> str | None:
    said, offset, fraction = (
        photo[tag].text() if tag in photo else "" for tag in (TAKEN, TAKEN_OFFSET, TAKEN_FRACTION)
    )
    try:
        time = datetime.strptime(said, "%Y:%m:%d %H:%M:%S").isoformat()
    except ValueError:
        return None  # "0000:00:00 00:00:00" of a clock that was never set
    time += f".{fraction[:6]}" if re.fullmatch(r"[0-9]+", fraction) else ""
    return time + (offset if re.fullmatch(r"[+-](0\d|1[0-4]):[0-5]\d", offset, re.ASCII) else "")
