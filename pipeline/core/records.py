"""The shared vocabulary: an image, its key, its position, and why one was rejected."""

import hashlib
import re
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any


class Split(StrEnum):
    """The part of a data set that an image belongs to. The official test set is all of query and
    gallery."""

    TRAIN = "train"
    QUERY = "query"
    GALLERY = "gallery"


class View(StrEnum):
    """Where an image was taken from. `google` is University-1652's street view images found by a
    web search."""

    DRONE = "drone"
    SATELLITE = "satellite"
    STREET = "street"
    GOOGLE = "google"


@dataclass(frozen=True, kw_only=True)
class GeoTag:
    """Position of the ground that an image shows, WGS84, and how the camera looked at it."""

    lat: float
    "Latitude of the ground shown, degrees north."
    lon: float
    "Longitude of the ground shown, degrees east."
    altitude_m: float | None = None
    "Height of the camera above the ground, metres."
    heading_deg: float | None = None
    "Direction in which the camera looks, degrees clockwise from north."
    pitch_deg: float | None = None
    "Angle of the optical axis above the horizon, degrees: -90 looks straight down."
    footprint: tuple[tuple[float, float], ...] | None = None
    """Corners (lat, lon) of the ground shown, from the image's upper left clockwise, where they are
    known."""
    roll_deg: float | None = None
    "Of the camera about its optical axis; above 0 the image's right side is the lower one."
    focal_35mm: float | None = None
    "Focal length of the same field of view on 35 mm film, millimetres."

    def as_json(self) -> dict[str, Any]:
        """All fields; roll and focal length only where they are known, so that tags without them
        are written as they were before there were these."""
        later = ("roll_deg", "focal_35mm")
        return {k: v for k, v in asdict(self).items() if v is not None or k not in later}


@dataclass(frozen=True, kw_only=True)
class ImageRecord:
    """One image as a source found it; its pixels have not been read."""

    path: str
    "The image file, or the file that the image is a part of; a plain path or a URI."
    part: str = ""
    "Which part of the file, in its source's words; empty if the image is the whole file."
    split: Split
    view: View
    location: str
    "The label: the folder's name, never an index."
    variant: str = ""
    """Distinguishes images of one name in one location, such as by the height that they were taken
    from."""
    level: str = ""
    """Which of several sizes of ground it shows, such as `60m` or `z17`, where its source cuts or
    holds more than one."""
    geotag: GeoTag | None = None
    taken_at: str | None = None
    "When, ISO 8601; without an offset it is the camera's own clock."
    bytes: int | None = None
    "Size of the file; None if the image is a part of one."
    unreadable_tags: str = ""
    "Tags of the file that could not be read, as sentences; the record does without them."

    @property
    def key(self) -> str:
        """Name of this image in the data set: `[a-z0-9_-]+`, derived from split, view, location,
        variant and file name."""
        stem = self.part or self.path.rsplit("/", 1)[-1].rsplit(".", 1)[0]
        named = f"{self.variant}-{stem}" if self.variant else stem
        return make_key(self.split, self.view, self.location, named)

    @property
    def name(self) -> str:
        """The name that a person would look for: the path, and which part of it."""
        return f"{self.path}#{self.part}" if self.part else self.path


MAX_KEY_LENGTH = 90
"A tar header of the oldest kind holds names of 100 characters, suffix included."
MAX_EXCERPT_LENGTH = 200
"Characters of a damaged value that are shown."
MAX_FOUND_LENGTH = 600
"Characters of `Rejection.found` that are kept."
MISSING_WORDS = frozenset(
    (
        "", "nan", "-nan", "na", "n/a", "<na>", "#n/a", "#n/a n/a", "null", "#null!", "none", "nil",
        "nat",
    )
)  # fmt: skip
"Words for a missing value in R, SQL, Python and spreadsheets, in lower case; pandas reads them so."
KEY_PATTERN = re.compile(rf"[a-z0-9_-]{{1,{MAX_KEY_LENGTH}}}")


def is_utf8(name: str) -> bool:
    """Whether text can be written as UTF-8: file names in other encodings hold lone surrogates."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def escape_non_utf8(name: str) -> str:
    """The text with characters that UTF-8 cannot hold written as escapes."""
    return name.encode("utf-8", "backslashreplace").decode()


def is_position(lat: object, lon: object) -> bool:
    """Whether these are degrees north and east of a point on the earth."""
    plain = all(
        isinstance(value, int | float) and not isinstance(value, bool) for value in (lat, lon)
    )
    return plain and -90 <= lat <= 90 and -180 <= lon <= 180  # type: ignore[operator]  # NaN: false


def excerpt(value: object) -> str:
    """The beginning of a value's repr, as much as a sentence can hold."""
    text = repr(value)
    return text if len(text) <= MAX_EXCERPT_LENGTH else f"{text[:MAX_EXCERPT_LENGTH]}..."


def make_key(split: Split, view: View, location: str, stem: str) -> str:
    """Key of an image: stable under re-sharding, without dots (webdataset cuts a name at the first
    one).

    If a character had to be replaced or the end cut off, eight digits of the original name's hash
    keep two names apart.
    """
    named = f"{split}-{view}-{location}-{stem}"
    slug = re.sub(r"[^a-z0-9_-]", "_", named.lower())
    if slug == named and len(slug) <= MAX_KEY_LENGTH:
        return slug
    digest = hashlib.sha256(named.encode("utf-8", "surrogateescape")).hexdigest()
    return f"{slug[: MAX_KEY_LENGTH - 9]}-{digest[:8]}"


def key_matches(key: str, split: Split, view: View, location: str) -> bool:
    """Whether a key that `make_key` made is of this split, view and location."""
    begin = re.sub(r"[^a-z0-9_-]", "_", f"{split}-{view}-{location}-".lower())
    return key.startswith(begin[: MAX_KEY_LENGTH - 9])


@dataclass(frozen=True, kw_only=True)
class Rejection:
    """A rejected image with its reason."""

    path: str
    reason: str
    "Short and countable: the same words for the same fault."
    found: str
    "What this file held, for the person who repairs it; at most MAX_FOUND_LENGTH characters."

    def __post_init__(self) -> None:
        found = escape_non_utf8(self.found)
        if len(found) > MAX_FOUND_LENGTH:  # a damaged file may hold a megabyte instead of a number
            found = f"{found[: MAX_FOUND_LENGTH - 3]}..."
        object.__setattr__(self, "found", found)


@dataclass(frozen=True, kw_only=True)
class SkippedFile:
    """A file that was passed over because it is no image that was asked for: a companion of images,
    an image of another height. It is counted by its reason, and is no rejected image.
    """

    path: str
    reason: str
    "Short and countable."
    count: int = 1
    "How many files or tiles of one kind this stands for."


Scanned = ImageRecord | Rejection | SkippedFile
"What a source yields for each thing that it comes upon."
