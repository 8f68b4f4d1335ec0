"""An upload and its fields -> a validated request, or an HTTP error of one sentence.

In: an upload's bytes and its fields as text. Out: a LocateRequest; RequestError with its HTTP
status where it is not valid. Nothing is decoded yet.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.core.errors import InputError
from pipeline.core.geo import Circle
from pipeline.images.decode import DecodeError
from pipeline.images.inspect import inspect
from pipeline.matching.photo_pose import PoseSettings

JPEG = b"\xff\xd8\xff"
SIGNATURES = ((JPEG, b""), (b"\x89PNG\r\n\x1a\n", b""), (b"RIFF", b"WEBP"))
"""First bytes of a file, and its bytes 8 to 12. Only formats whose size is known without decoding:
Pillow knows some 40 more, and each of their decoders would be exposed to strangers."""

SCAN_MARKER, MAX_SCANS = b"\xff\xda", 100
"""Marker of a scan of a JPEG, and the number of scans that is accepted: progressive files have
about ten. Thousands of empty ones in a few kilobytes would each cost a pass over all pixels. A
preview within a header may contain the same two bytes by chance."""

DEFAULT_TOP, MAX_TOP = 5, 50
"Candidates in an answer."

CAMERA_FIELDS = ("fov", "height", "heading", "pitch")
"Fields of what is known of the camera; they overrule the photo's tags."
NOTHING_KNOWN = PoseSettings()
"Of the camera: the tags alone."
FIELDS = ("lat", "lon", "radius_m", "top", *CAMERA_FIELDS)


class RequestError(Exception):
    """A request that is refused; `sentence` says what was found, what was expected and what to
    do."""

    def __init__(self, status: int, sentence: str, retry_after_s: int | None = None) -> None:
        super().__init__(sentence)
        self.status, self.sentence, self.retry_after_s = status, sentence, retry_after_s


@dataclass(frozen=True, kw_only=True)
class LocateRequest:
    """A photo to locate, and where to search."""

    photo: bytes
    "A complete JPEG, PNG or WebP file."
    near: Circle | None = None
    "Only gallery images within this circle are candidates."
    top: int = DEFAULT_TOP
    "Candidates in the answer."
    pose: PoseSettings = NOTHING_KNOWN
    "What is known of the camera beside the photo's tags."


def parse_request(photo: bytes, fields: Mapping[str, str], max_pixels: int) -> LocateRequest:
    """Validate an upload by its structure: no pixel is decoded, except for CMYK JPEGs, whose size
    is known by then.

    Raises RequestError.

    """
    request = LocateRequest(photo=photo, near=_near(fields), top=_top(fields), pose=_pose(fields))
    _check_photo(photo, max_pixels)
    return request


def _near(fields: Mapping[str, str]) -> Circle | None:
    names = ("lat", "lon", "radius_m")
    given = {name: fields[name] for name in names if fields.get(name, "").strip()}
    if not given:
        return None
    if len(given) < 3:
        raise RequestError(
            400,
            f"found only {' and '.join(given)}, expected all of lat, lon and radius_m or none; "
            "give the others too",
        )
    try:
        return Circle(**{name: _number(name, text) for name, text in given.items()})
    except InputError as error:
        raise RequestError(400, str(error)) from None


def _pose(fields: Mapping[str, str]) -> PoseSettings:
    given = {name: fields[name] for name in CAMERA_FIELDS if fields.get(name, "").strip()}
    try:
        known = {name: _number(name, text) for name, text in given.items()}
        return PoseSettings(
            fov=known.get("fov"),
            height=known.get("height"),
            heading=known.get("heading"),
            pitch=known.get("pitch"),
        )
    except InputError as error:
        raise RequestError(400, str(error).removeprefix("--")) from None


def _number(name: str, text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise RequestError(400, f"{name} is {text[:40]!r}, expected a number such as 47.5")
    return number


def _top(fields: Mapping[str, str]) -> int:
    text = fields.get("top", "").strip()
    if not text:
        return DEFAULT_TOP
    short_number = text.isascii() and text.isdigit() and len(text) < 4
    if not (short_number and 1 <= int(text) <= MAX_TOP):
        raise RequestError(
            400, f"top is {text[:40]!r}, expected a whole number from 1 to {MAX_TOP}"
        )
    return int(text)


def _check_photo(photo: bytes, max_pixels: int) -> None:
    if not photo:
        raise RequestError(
            400, "the photo is empty, expected the bytes of a JPEG, PNG or WebP file"
        )
    if not any(photo.startswith(first) and photo.startswith(then, 8) for first, then in SIGNATURES):
        raise RequestError(
            415,
            f"the photo begins with {photo[:8]!r}, expected a JPEG, PNG or WebP file; save it as "
            "one of these",
        )
    if photo.startswith(JPEG) and (scans := photo.count(SCAN_MARKER)) > MAX_SCANS:
        raise RequestError(
            422,
            f"the photo has {scans} scans, expected at most {MAX_SCANS}; save it as a plain JPEG",
        )
    try:
        inspect(photo, max_pixels)
    except DecodeError as error:
        raise undecodable_photo(error.reason, error.found) from None


def undecodable_photo(reason: str, found: str) -> RequestError:
    """The error for a photo that cannot be decoded."""
    return RequestError(
        413 if reason == "too many pixels" else 422,
        f"the photo cannot be used: {reason}, {found}; send it complete, or a smaller copy of it",
    )
