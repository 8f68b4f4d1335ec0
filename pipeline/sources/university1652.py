"""University-1652 as its authors lay it out on disk -> ImageRecords. The simulator writes the same layout.

`train/{satellite,drone,street,google}/<location>/` and `test/{query,gallery}_{satellite,drone,street}/<location>/`. Where
`locations.csv` and `poses.csv` lie at the root, as the simulator writes them, geotags are taken from there.
"""

import csv
import io
from collections.abc import Iterator
from dataclasses import dataclass

from pipeline import storage
from pipeline.records import GeoTag, ImageRecord, InputError, Rejection, Split, View
from pipeline.sources.source import Source, is_image, not_an_image

FOLDERS: dict[str, tuple[Split, View]] = {
    f"{phase}/{folder}": (split, view)
    for phase, split, prefix in (
        ("train", Split.TRAIN, ""),
        ("test", Split.QUERY, "query_"),
        ("test", Split.GALLERY, "gallery_"),
    )
    for view in View
    for folder in [f"{prefix}{view}"]
}


@dataclass(frozen=True, kw_only=True)
class University1652(Source):
    """University-1652, official layout."""

    views: tuple[View, ...] = (View.DRONE, View.SATELLITE)
    "Views that are taken. PVDA is trained and tested on these two; street and google are there for who asks for them."

    def scan(self, root: str) -> Iterator[ImageRecord | Rejection]:
        if not storage.is_folder(root):
            raise InputError(
                f"no folder {root}; expected University-1652's root, which holds train and test; check --root"
            )
        tags = read_geotags(root)
        found = False
        for folder, (split, view) in FOLDERS.items():
            below = storage.join(root, folder)
            if view not in self.views or not storage.is_folder(below):
                continue
            for path, size in storage.walk(below).items():
                location, _, name = path.rpartition("/")
                whole = storage.join(below, path)
                if not location or "/" in location:
                    yield Rejection(path=whole, reason="wrong folder", found=f"{path} is not <location>/<image>")
                elif not is_image(name):
                    yield not_an_image(whole)
                else:
                    found = True
                    tag = tags.get(f"{folder}/{path}") or tags.get(location)
                    yield ImageRecord(path=whole, split=split, view=view, location=location, geotag=tag, bytes=size)
        if not found:
            raise InputError(
                f"no images below {root}; expected train/{{satellite,drone}}/<location>/ and "
                "test/{query,gallery}_{satellite,drone}/<location>/; check --root"
            )


def read_geotags(root: str) -> dict[str, GeoTag]:
    """Geotags by location, and with the camera's pose by path, from the two tables at the root, where they are."""
    places = {row["location"]: (float(row["lat"]), float(row["lon"])) for row in _rows(root, "locations.csv")}
    tags = {location: GeoTag(lat=lat, lon=lon) for location, (lat, lon) in places.items()}
    for row in _rows(root, "poses.csv"):
        lat, lon = places[row["location"]]
        altitude, heading, pitch = (float(row[name]) for name in ("altitude_m", "heading_deg", "pitch_deg"))
        tags[row["path"]] = GeoTag(lat=lat, lon=lon, altitude_m=altitude, heading_deg=heading, pitch_deg=pitch)
    return tags


def _rows(root: str, name: str) -> Iterator[dict[str, str]]:
    path = storage.join(root, name)
    if not storage.exists(path):
        return
    try:
        yield from csv.DictReader(io.StringIO(storage.read_bytes(path).decode()))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path} cannot be read as a table ({error}); mend it or take it away") from None
