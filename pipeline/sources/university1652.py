"""University-1652 as its authors distribute it -> ImageRecords. The simulator writes this layout.

`train/{satellite,drone,street,google}/<location>/` and
`test/{query,gallery}_{satellite,drone,street}/<location>/`. Geotags lie beside the images: the
authors publish one `<location>.kml` per building, which the flag `kml` names, and the simulator
writes `locations.csv` and `poses.csv` at the root, which are read without a flag.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

from pipeline.camera.lens import focal_length_35mm
from pipeline.core import storage
from pipeline.core.records import GeoTag, Rejection, Scanned, View
from pipeline.sources.base import Source
from pipeline.sources.folders import LocatedImage, SplitFolder, images_by_split, require_images
from pipeline.sources.kml import read_kmls
from pipeline.sources.text_tables import (
    TagTable,
    Unreadable,
    parse_number,
    parse_optional_number,
    parse_position,
    read_rows,
    unreadable_tag_row,
)

_LAYOUT = (
    "University-1652's root, which holds train/{satellite,drone}/<location>/ and "
    "test/{query,gallery}_{satellite,drone}/<location>/"
)
POSE = ("altitude_m", "heading_deg", "pitch_deg")


@dataclass(frozen=True, kw_only=True)
class University1652(Source):
    """University-1652, official layout."""

    views: tuple[View, ...] = (View.DRONE, View.SATELLITE)
    """Views to pack. PVDA is trained and tested on these two; street and google are optional."""
    kml: str = ""
    """Folder with the buildings' KML files, `<location>.kml`, as the authors distribute them;
    empty: no geotags from there."""

    def scan(self, root: str) -> Iterator[Scanned]:
        return require_images(self._scan(root), root, _LAYOUT)

    def _scan(self, root: str) -> Iterator[Scanned]:
        tags = TagTable()
        yield from read_pose_tables(root, tags)
        if self.kml:
            yield from read_kmls(self.kml, tags)

        def tag(folder: SplitFolder, image: LocatedImage) -> GeoTag | None:
            path = f"{folder.phase}/{folder.folder}/{image.location}/{image.name}"
            return tags.find(path, image.location)

        yield from images_by_split(root, [view for view in View if view in self.views], tag)


def read_pose_tables(root: str, tags: TagTable) -> list[Rejection]:
    """Adds geotags from the two tables at the root, where they exist: by location, and with the
    camera's pose by path. Returns the lines that could not be read.

    Raises InputError when one of them has other columns.
    """
    rejected = []
    path = storage.join(root, "locations.csv")
    if storage.exists(path):
        for line, row in read_rows(path, ("location", "lat", "lon")):
            try:
                lat, lon = parse_position(row["lat"], row["lon"])
                tags.add(row["location"], GeoTag(lat=lat, lon=lon))
            except Unreadable as error:
                rejected.append(unreadable_tag_row(path, line, ",".join(row.values()), error))
    path = storage.join(root, "poses.csv")
    if storage.exists(path):
        for line, row in read_rows(path, ("path", "location", *POSE)):
            try:
                if row["location"] not in tags:
                    raise Unreadable(f"location {row['location']!r} has no line in locations.csv")
                altitude, heading, pitch = (parse_number(row[name]) for name in POSE)
                tag = tags.find(row["location"])
                if tag is not None:
                    tag = replace(tag, altitude_m=altitude, heading_deg=heading, pitch_deg=pitch)
                    fov = parse_optional_number(row.get("fov_deg", ""))
                    if fov is not None and not 0 < fov < 180:
                        raise Unreadable(f"fov_deg {fov:g} is not between 0 and 180")
                    if fov is not None:  # its images are squares
                        tag = replace(tag, focal_35mm=round(focal_length_35mm(fov, (1, 1)), 3))
                    tags.add(row["path"], tag)
            except Unreadable as error:
                rejected.append(unreadable_tag_row(path, line, ",".join(row.values()), error))
    return rejected
