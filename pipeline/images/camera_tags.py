"""The camera tags of a photo: bytes of the image's beginning -> position, heights, angles, lens,
time.

In: bytes. Out: CameraTags. Pure, and bounded in time and memory whatever the bytes are. A tag that
cannot be read costs only its own value: an unreadable block is treated as absent and listed in
`ignored`. A position that cannot be right, with no other statement of it, is an error
(`camera_position`).

EXIF names and units: CIPA DC-008. XMP names: DJI's list for the Zenmuse P1 and Mavic 3
(`drone-dji`), which Autel took over; Parrot's and Skydio's own beside them. Pix4D's Camera:Yaw and
Camera:Pitch are not used: makers disagree on where their pitch has its zero.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime

from pipeline.images.camera_position import parse_number, read_position
from pipeline.images.exif import XMP_TAG, Directory, read_exif
from pipeline.images.image_blocks import MetadataBlocks, UnreadableTag
from pipeline.images.xmp import read_xmp

ALTITUDE_REF, ALTITUDE, DIRECTION_REF, DIRECTION = 5, 6, 16, 17
TAKEN, TAKEN_OFFSET, TAKEN_FRACTION = 0x9003, 0x9011, 0x9291
MODEL, FOCAL, FOCAL_35MM = 0x0110, 0x920A, 0xA405
WIDTH, HEIGHT = 0xA002, 0xA003
XMP_HEIGHT = ("AboveGroundAltitude", "RelativeAltitude")
XMP_HEADING = ("GimbalYawDegree", "CameraYawDegree", "CameraOrientationNED.Yaw")
XMP_BODY_HEADING = ("FlightYawDegree", "DroneYawDegree")
XMP_PITCH = ("GimbalPitchDegree", "CameraPitchDegree", "CameraOrientationNED.Pitch")
XMP_FOCAL_PX = ("CalibratedFocalLength",)
XMP_ROLL = ("GimbalRollDegree", "CameraRollDegree", "CameraOrientationNED.Roll")
GIMBAL_OVERSHOOT_DEG = 1.0
"By which gimbals overshoot straight down: -90.1 is common."
NADIR_PITCH_DEG = -60.0
"""Below it a roll beyond 90 degrees means that the gimbal passed straight down: yaw and roll both
jump by 180 there, and the image's top still points the other way."""


@dataclass(frozen=True, kw_only=True)
class CameraTags:
    """Where the camera was and how it looked; None is unknown."""

    position: tuple[float, float] | None = None
    "The camera's own latitude and longitude, degrees, WGS84. Not the ground that it looks at."
    height_m: float | None = None
    """Above the ground, or, as nearly all cameras know nothing else, above the point of take-off;
    metres."""
    sea_level_m: float | None = None
    "Altitude above sea level or ellipsoid (cameras do not say which), metres."
    heading_deg: float | None = None
    "Of the camera, else of the aircraft; clockwise from true north, from 0 to below 360."
    pitch_deg: float | None = None
    "Of the optical axis, from -90 (straight down) to 90."
    roll_deg: float | None = None
    "About the optical axis, from -90 to 90; above 0 the image's right side is the lower one."
    focal_px: float | None = None
    "Calibrated focal length in pixels of the photo as it was taken."
    focal_35mm: float | None = None
    "Focal length of the same field of view on 35 mm film, millimetres."
    focal_mm: float | None = None
    "Focal length, millimetres."
    model: str = ""
    "Of the camera."
    taken_size: tuple[int, int] | None = None
    "Width and height of the photo as it was taken, pixels, before it was turned upright."
    taken_at: str | None = None
    "ISO 8601; without an offset the camera's own clock."
    ignored: tuple[str, ...] = ()
    "Blocks and tags that are there and could not be used, as sentences."


def read_tags(blocks: MetadataBlocks) -> CameraTags:
    """The tags of an image with these metadata blocks.

    EXIF's position is taken before XMP's; XMP's gimbal before EXIF's direction, and that before the
    aircraft's heading. Raises UnreadableTag if positions contradict each other, or the only one
    cannot be right.
    """
    exif = read_exif(blocks.exif or b"")
    ignored = list(exif.unreadable)
    packet = blocks.xmp or (exif.main[XMP_TAG].raw if XMP_TAG in exif.main else None)
    xmp: dict[str, str] = {}
    try:
        xmp = read_xmp(packet) if packet else {}
    except UnreadableTag as error:
        ignored.append(str(error))
    position, unreadable = read_position(exif.gps, xmp)
    ignored += unreadable
    pitch = _first_number(xmp, XMP_PITCH, ignored)
    if pitch is not None and abs(pitch) > 90:
        overshoot = abs(pitch) <= 90 + GIMBAL_OVERSHOOT_DEG
        ignored += [] if overshoot else [f"a pitch of {pitch:g}, not from -90 to 90"]
        pitch = max(-90.0, min(90.0, pitch)) if overshoot else None
    height, sea_level = _first_number(xmp, XMP_HEIGHT, ignored), _altitude(exif.gps)
    if sea_level is None:
        sea_level = _first_number(xmp, ("AbsoluteAltitude",), ignored)
    heading, taken_at = _heading(exif.gps, xmp, pitch, ignored), _taken_at(exif.photo, ignored)
    roll = _first_number(xmp, XMP_ROLL, ignored)
    focal_35mm, width, height_px = (
        exif.photo[tag].integer() if tag in exif.photo else None
        for tag in (FOCAL_35MM, WIDTH, HEIGHT)
    )
    return CameraTags(
        position=position,
        height_m=height,
        sea_level_m=sea_level,
        heading_deg=heading,
        pitch_deg=pitch,
        roll_deg=None if roll is None else (roll + 90) % 180 - 90,
        focal_px=_above_zero(_first_number(xmp, XMP_FOCAL_PX, ignored)),
        focal_35mm=_above_zero(focal_35mm),
        focal_mm=_above_zero(_first_rational(exif.photo, FOCAL)),
        model=exif.main[MODEL].text() if MODEL in exif.main else "",
        taken_size=(width, height_px) if width and height_px else None,
        taken_at=taken_at,
        ignored=tuple(dict.fromkeys(ignored)),
    )


def _heading(
    gps: Directory, xmp: Mapping[str, str], pitch: float | None, ignored: list[str]
) -> float | None:
    gimbal = _first_number(xmp, XMP_HEADING, ignored)
    roll = _first_number(xmp, XMP_ROLL, ignored)
    if gimbal is not None:
        rolled_over = roll is not None and 90 < abs(roll) <= 180
        nadir = pitch is None or pitch <= NADIR_PITCH_DEG
        return (gimbal + (180 if rolled_over and nadir else 0)) % 360
    direction = _direction(gps, ignored)
    heading = _first_number(xmp, XMP_BODY_HEADING, ignored) if direction is None else direction
    return None if heading is None else heading % 360


def _first_number(
    xmp: Mapping[str, str], names: tuple[str, ...], ignored: list[str]
) -> float | None:
    """The first of these properties that is a number; those before it that hold something else are
    added to `ignored`.
    """
    for name in names:
        text = xmp.get(name, "").strip()
        value = parse_number(text)
        if value is not None:
            return value
        if text:
            ignored.append(f"{name} {text[:40]!r}")
    return None


def _above_zero(value: float | None) -> float | None:
    """Zero is EXIF's word for unknown."""
    return float(value) if value is not None and value > 0 else None


def _first_rational(gps: Directory, tag: int) -> float | None:
    parts = gps[tag].rationals() if tag in gps else None
    value = parts[0][0] / parts[0][1] if parts and parts[0][1] else math.nan
    return value if math.isfinite(value) else None


def _altitude(gps: Directory) -> float | None:
    value = _first_rational(gps, ALTITUDE)
    # 2 and 3: EXIF 3.0, of the ellipsoid
    below = ALTITUDE_REF in gps and gps[ALTITUDE_REF].integer() in (1, 3)
    return -value if value is not None and below else value


def _direction(gps: Directory, ignored: list[str]) -> float | None:
    """Degrees from true north; None if magnetic, because the declination is unknown here."""
    value = _first_rational(gps, DIRECTION)
    if value is None:
        return None
    if DIRECTION_REF in gps and gps[DIRECTION_REF].text().upper() == "M":
        ignored.append("GPSImgDirection from magnetic north")
        return None
    if not 0 <= value <= 360:
        ignored.append(f"GPSImgDirection {value:g}, not from 0 to 360")
        return None
    return value


def _taken_at(photo: Directory, ignored: list[str]) -> str | None:
    taken, offset, fraction = (
        photo[tag].text() if tag in photo else "" for tag in (TAKEN, TAKEN_OFFSET, TAKEN_FRACTION)
    )
    try:
        time = datetime.strptime(taken, "%Y:%m:%d %H:%M:%S").isoformat()
    except ValueError:
        if re.search(r"[1-9]", taken):  # else "0000:00:00 00:00:00" of a clock that was never set
            ignored.append(f"DateTimeOriginal {taken[:40]!r}")
        return None
    time += f".{fraction[:6]}" if re.fullmatch(r"[0-9]+", fraction) else ""
    return time + (offset if re.fullmatch(r"[+-](0\d|1[0-4]):[0-5]\d", offset, re.ASCII) else "")
