"""University-1652 as its authors lay it out on disk -> ImageRecords. The simulator writes the same
layout.

`train/{satellite,drone,street,google}/<location>/` and `test/{query,gallery}_{satellite,drone,street}/<location>/`.
Geotags come apart from the images: the authors give out one `<location>.kml` per building, which `kml` takes, and where
`locations.csv` and `poses.csv` lie at the root, as the simulator writes them, they are taken from there.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from pipeline.core import storage
from pipeline.core.records import GeoTag, ImageRecord, Rejection, View
from pipeline.sources.base import Source
from pipeline.sources.folders import LocatedImage, SplitFolder, images_by_split, require_images
from pipeline.sources.kml import read_kmls
from pipeline.sources.text_tables import (
    Unreadable,
    parse_number,
    parse_position,
    read_rows,
    unreadable_tag_row,
)

LAYOUT = (
    "University-1652's root, which holds train/{satellite,drone}/<location>/ and "
    "test/{query,gallery}_{satellite,drone}/<location>/"
)
POSE = ("altitude_m", "heading_deg", "pitch_deg")


@dataclass(frozen=True, kw_only=True)
class University1652(Source):
    """University-1652, official layout."""

    views: tuple[View, ...] = (View.DRONE, View.SATELLITE)
    """Views that are taken. PVDA is trained and tested on these two; street and google are there
    for who asks for them."""
    kml: str = ""
    """Folder with the buildings' KML files, `<location>.kml`, as its authors give them out; empty:
    no geotags from there."""

    def scan(self, root: str) -> Iterator[ImageRecord | Rejection]:
        return require_images(self._scan(root), root, LAYOUT)

    def _scan(self, root: str) -> Iterator[ImageRecord | Rejection]:
        tags, rejected = read_geotags(root)
        yield from rejected
        if self.kml:
            places, rejected = read_kmls(self.kml)
            yield from rejected
            tags |= places

        def tag(folder: SplitFolder, image: LocatedImage) -> GeoTag | None:
            own = tags.get(f"{folder.phase}/{folder.folder}/{image.location}/{image.name}")
            return own or tags.get(image.location)

        yield from images_by_split(root, [view for view in View if view in self.views], tag)


def read_geotags(root: str) -> tuple[dict[str, GeoTag], list[Rejection]]:
    """Geotags by location, and with the camera's pose by path, from the two tables at the root,
    where they are.

    Raises InputError when one of them is no such table.
    """
    tags: dict[str, GeoTag] = {}
    rejected = []
    for table, columns in (
        ("locations.csv", ("location", "lat", "lon")),
        ("poses.csv", ("path", "location", *POSE)),
    ):
        path = storage.join(root, table)
        if not storage.exists(path):
            continue
        for line, row in read_rows(path, columns):
            try:
                if "path" not in columns:
                    lat, lon = parse_position(row["lat"], row["lon"])
                    tags[row["location"]] = GeoTag(lat=lat, lon=lon)
                elif row["location"] in tags:
                    altitude, heading, pitch = (parse_number(row[name]) for name in POSE)
                    where = tags[row["location"]]
                    tags[row["path"]] = GeoTag(
                        lat=where.lat,
                        lon=where.lon,
                        altitude_m=altitude,
                        heading_deg=heading,
                        pitch_deg=pitch,
                    )
                else:
                    raise Unreadable(f"location {row['location']!r} has no line in locations.csv")
            except Unreadable as error:
                rejected.append(unreadable_tag_row(path, line, ",".join(row.values()), error))
    return tags, rejected
