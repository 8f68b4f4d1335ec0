"""A folder of photos as they come off a UAV's card -> ImageRecords with the geotags that the camera
wrote.

In: any folders below a root. Out: a record per image name, in the order of their paths. Only the
beginning of a JPEG is read.
"""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.prefetch import prefetch_map
from pipeline.core.records import GeoTag, ImageRecord, Rejection, Split, View
from pipeline.images.camera_tags import CameraTags, read_tags
from pipeline.images.image_blocks import UnreadableTag, find_metadata
from pipeline.images.inspect import is_image_name
from pipeline.sources.base import Source, not_an_image

HEAD_BYTES = 256 << 10
"""Bytes that are read of a file: the first two or three segments of 64 kB hold EXIF and XMP in all
cameras seen."""
THREADS, PREFETCH = 16, 256
"""Files whose beginnings are read at once, as scanning waits for disks and networks; and how far
ahead of the consumer."""
COMPANIONS = (
    ".dng",
    ".mp4",
    ".mov",
    ".srt",
    ".lrf",
    ".mrk",
    ".nav",
    ".obs",
    ".bin",
    ".txt",
    ".csv",
    ".json",
    ".xml",
    ".kml",
    ".thm",
)
"""Endings of what cameras write beside photos: raw copies, films, flight logs. Left out without a
word."""
EARTH_RADIUS_M = 6_371_008.8  # mean radius, IUGG
MAX_PITCH_DEG = (
    -20.0
)  # above this the axis arrives 2.7 heights away and more, where a degree of pitch moves it by far


@dataclass(frozen=True, kw_only=True)
class Photos(Source):
    """UAV photos in folders, geotags from EXIF and XMP."""

    view: View = View.DRONE
    "What the photos show their places from."
    split: Split = Split.QUERY
    "What the photos are: queries, gallery or training images."
    location: Literal["folder", "file"] = "folder"
    """What one location is. folder: all photos of a folder show one place, named by the folder's
    path below the root (a photo directly at the root: by its file name). file: each photo is a
    place of its own, named by its path without the ending."""
    geotags: Literal["read", "required", "ignored"] = "read"
    """read: a photo without a position is kept with none. required: it is refused. ignored: no tag
    is read, which is quickest. A photo whose position is there and cannot be right is refused
    unless tags are ignored."""
    project: bool = False
    """Put the position where the optical axis meets flat ground, if height, heading and pitch are
    known and the camera looks 20 degrees or more below the horizon. Otherwise it is the camera's
    own; the place shown lies height / tan(-pitch) ahead."""

    def scan(self, root: str) -> Iterator[ImageRecord | Rejection]:
        if not storage.is_folder(root):
            raise InputError(f"no folder {root}; expected a folder of photos; check --root")
        files = storage.walk(root)
        if not any(map(is_image_name, files)):
            others = Counter(path.rpartition(".")[2] for path in files).most_common(3)
            said = ", ".join(f"{count} .{ending}" for ending, count in others) or "nothing at all"
            raise InputError(
                f"no images below {root}, but {said}; expected photos in any folders; check --root"
            )
        photos = [
            (path, size) for path, size in files.items() if not path.lower().endswith(COMPANIONS)
        ]
        yield from prefetch_map(lambda photo: self._judge(root, *photo), photos, THREADS, PREFETCH)

    def _judge(self, root: str, path: str, size: int) -> ImageRecord | Rejection:
        whole = storage.join(root, path)
        if not is_image_name(path):
            return not_an_image(whole)
        try:
            tags = CameraTags() if self.geotags == "ignored" else read_photo(whole, size)
        except UnreadableTag as error:
            return Rejection(path=whole, reason="unreadable tag", found=str(error))
        except OSError as error:
            return Rejection(path=whole, reason="unreadable file", found=str(error))
        if self.geotags == "required" and tags.position is None:
            found = "; ".join(tags.ignored) or "neither EXIF nor XMP holds one"
            return Rejection(path=whole, reason="no position", found=found)
        folder, _, name = path.rpartition("/")
        return ImageRecord(
            path=whole, split=self.split, view=self.view, bytes=size, taken_at=tags.taken_at,
            location=(folder or name) if self.location == "folder" else path.rpartition(".")[0],
            geotag=geotag_of_photo(tags, self.project),
        )  # fmt: skip


def read_photo(path: str, size: int) -> CameraTags:
    """The tags of an image file of `size` bytes: from its beginning, or from all of it where the
    tags may lie further on.

    Raises UnreadableTag, OSError.
    """
    if not size:
        return CameraTags()  # packing refuses it; object stores refuse a range of nothing
    blocks = find_metadata(storage.read_head(path, HEAD_BYTES), complete=size <= HEAD_BYTES)
    if blocks.truncated and size > HEAD_BYTES:
        blocks = find_metadata(storage.read_bytes(path), complete=True)
    return read_tags(blocks)


def geotag_of_photo(tags: CameraTags, project: bool) -> GeoTag | None:
    """The geotag of a photo; None without a position.

    Its height is the one above take-off; an altitude above the sea is none above the ground, and is
    left out.
    """
    if tags.position is None:
        return None
    lat, lon = tags.position
    height, heading, pitch = tags.height_m, tags.heading_deg, tags.pitch_deg
    if project and height is not None and height > 0 and heading is not None and pitch is not None:
        lat, lon = (
            aim_point(lat, lon, height, heading, pitch) if pitch <= MAX_PITCH_DEG else (lat, lon)
        )
    return GeoTag(lat=lat, lon=lon, altitude_m=height, heading_deg=heading, pitch_deg=pitch)


def aim_point(
    lat: float, lon: float, height_m: float, heading_deg: float, pitch_deg: float
) -> tuple[float, float]:
    """Latitude and longitude at which the optical axis meets the ground: height / tan(-pitch)
    metres along the heading.

    Angles in degrees, pitch from -90 (straight down) to below 0. The ground is flat and as high as
    where the height is measured from; the way along it is a great circle on a sphere, which is
    within 0.6% of the distance.
    """
    way = height_m / math.tan(math.radians(-pitch_deg)) / EARTH_RADIUS_M
    bearing, north = math.radians(heading_deg), math.radians(lat)
    sine = math.sin(north) * math.cos(way) + math.cos(north) * math.sin(way) * math.cos(bearing)
    east = math.atan2(
        math.sin(bearing) * math.sin(way) * math.cos(north), math.cos(way) - math.sin(north) * sine
    )
    return math.degrees(math.asin(max(-1.0, min(1.0, sine)))), (
        lon + math.degrees(east) + 180
    ) % 360 - 180
