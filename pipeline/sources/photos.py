"""A folder of photos as they come off a UAV's card -> ImageRecords with the geotags that the camera
wrote.

In: any folders below a root. Out: a record per photo, in the order of their paths. Only the
beginning of a JPEG is read.
"""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from pipeline.camera.ground import looked_at
from pipeline.camera.lens import field_of_view, focal_length_35mm
from pipeline.camera.pose import Pose
from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.prefetch import prefetch_map
from pipeline.core.records import (
    GeoTag,
    ImageRecord,
    Rejection,
    Scanned,
    SkippedFile,
    Split,
    View,
)
from pipeline.images.camera_tags import CameraTags, read_tags
from pipeline.images.image_blocks import UnreadableTag, find_metadata
from pipeline.images.inspect import RAW_SUFFIXES
from pipeline.images.optional_formats import (
    extra_for,
    find_optional_metadata,
    is_decodable_name,
    undecodable_format,
)
from pipeline.sources.base import Source, not_an_image
from pipeline.sources.maps.georeference import ELLIPSOID

HEAD_BYTES = 256 << 10
"""Read of each file first: the first two or three segments of 64 kB hold EXIF and XMP in all
cameras seen."""
THREADS, PREFETCH = 16, 256
"""Files whose beginnings are read at once, as scanning waits for disks and networks; and how many
are read before the consumer asks for them."""
MAX_PITCH_DEG = -20.0
"""Above this pitch the optical axis meets the ground 2.7 heights away or further, where a degree of
pitch moves that point a long way."""

ANY_FOV_DEG = 60.0
"Of a photo's middle, which every lens sees in the same place."


@dataclass(frozen=True, kw_only=True)
class Photos(Source):
    """UAV photos in folders, geotags from EXIF and XMP."""

    view: View = View.DRONE
    "Of the photos."
    split: Split = Split.QUERY
    "The part of the data set that the photos become: queries, gallery or training images."
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

    def scan(self, root: str) -> Iterator[Scanned]:
        if not storage.is_folder(root):
            raise InputError(f"no folder {root}; expected a folder of photos; check --root")
        files = storage.walk(root)
        if not any(map(is_decodable_name, files)):
            endings = Counter(path.rpartition(".")[2] for path in files).most_common(3)
            found = ", ".join(f"{count} .{ending}" for ending, count in endings)
            undecoded = next(filter(None, map(undecodable_format, files)), None)
            found += f" ({undecoded.found})" if undecoded else ""
            raise InputError(
                f"no images below {root}, but {found or 'nothing at all'}; expected photos in any "
                "folders; check --root"
            )
        stems = {_stem(path) for path in files if is_decodable_name(path) and not _is_raw(path)}
        yield from prefetch_map(
            lambda photo: self._read(root, *photo, stems), list(files.items()), THREADS, PREFETCH
        )

    def _read(self, root: str, path: str, size: int, stems: set[str]) -> Scanned:
        """A file's record. `stems`: the paths of all photos but raw ones, without their endings."""
        full_path = storage.join(root, path)
        if _is_raw(path) and _stem(path) in stems:
            return SkippedFile(path=full_path, reason="raw copy of a photo")
        if not is_decodable_name(path):
            return undecodable_format(full_path) or not_an_image(full_path)
        try:
            ignored = self.geotags == "ignored"
            tags = CameraTags() if ignored else read_photo(full_path, size)
        except UnreadableTag as error:
            return Rejection(path=full_path, reason="unreadable tag", found=str(error))
        except OSError as error:
            return Rejection(path=full_path, reason="unreadable file", found=str(error))
        if self.geotags == "required" and tags.position is None:
            found = "; ".join(tags.ignored) or "neither EXIF nor XMP holds one"
            return Rejection(path=full_path, reason="no position", found=found)
        folder, _, name = path.rpartition("/")
        by_folder = self.location == "folder"
        return ImageRecord(
            path=full_path,
            split=self.split,
            view=self.view,
            location=(folder or name) if by_folder else path.rpartition(".")[0],
            geotag=geotag_of_photo(tags, self.project),
            taken_at=tags.taken_at,
            bytes=size,
            unreadable_tags="; ".join(tags.ignored),
        )


def _is_raw(path: str) -> bool:
    return path.lower().endswith(RAW_SUFFIXES)


def _stem(path: str) -> str:
    return path.rpartition(".")[0].lower()


def read_photo(path: str, size: int) -> CameraTags:
    """The tags of an image file of `size` bytes: from its beginning, or from all of it where the
    tags may lie further on.

    Raises UnreadableTag, OSError.
    """
    if not size:
        return CameraTags()  # packing refuses the file; object stores refuse an empty range
    if extra_for(path):  # their tags may lie anywhere
        return read_tags(find_optional_metadata(path, storage.read_bytes(path)))
    blocks = find_metadata(storage.read_head(path, HEAD_BYTES), complete=size <= HEAD_BYTES)
    if blocks.truncated and size > HEAD_BYTES:
        blocks = find_metadata(storage.read_bytes(path), complete=True)
    return read_tags(blocks)


def geotag_of_photo(tags: CameraTags, project: bool) -> GeoTag | None:
    """The geotag of a photo; None without a position.

    Its height is the one above take-off; an altitude above the sea is not a height above the
    ground, and is ignored.
    """
    if tags.position is None:
        return None
    lat, lon = tags.position
    height, heading, pitch = tags.height_m, tags.heading_deg, tags.pitch_deg
    if (
        project
        and height is not None
        and heading is not None
        and pitch is not None
        and height > 0
        and pitch <= MAX_PITCH_DEG
    ):
        lat, lon = aim_point(lat, lon, height, heading, pitch)
    return GeoTag(
        lat=lat,
        lon=lon,
        altitude_m=height,
        heading_deg=heading,
        pitch_deg=pitch,
        roll_deg=tags.roll_deg,
        focal_35mm=equivalent_focal_length(tags),
    )


def equivalent_focal_length(tags: CameraTags) -> float | None:
    """The focal length on 35 mm film, by whatever the tags say of the lens; None where that is not
    enough."""
    if tags.taken_size is None:
        return tags.focal_35mm
    fov = field_of_view(
        tags.taken_size,
        focal_px=tags.focal_px,
        focal_35mm=tags.focal_35mm,
        focal_mm=tags.focal_mm,
        model=tags.model,
    )
    return None if fov is None else round(focal_length_35mm(fov, tags.taken_size), 3)


def aim_point(
    lat: float, lon: float, height_m: float, heading_deg: float, pitch_deg: float
) -> tuple[float, float]:
    """Latitude and longitude at which the optical axis meets the ground: `looked_at`, along a
    geodesic of WGS84.

    Angles in degrees, pitch from -90 (straight down) to MAX_PITCH_DEG. The ground is flat and as
    high as where the height is measured from.
    """
    pose = Pose(
        x_m=0.0, y_m=0.0, altitude_m=height_m, heading_deg=heading_deg, pitch_deg=pitch_deg,
        fov_deg=ANY_FOV_DEG,
    )  # fmt: skip
    east, north = looked_at(pose)
    azimuth_deg = math.degrees(math.atan2(east, north))
    aim_lon, aim_lat, _ = ELLIPSOID.fwd(lon, lat, azimuth_deg, math.hypot(east, north))
    return float(aim_lat), float(aim_lon)
