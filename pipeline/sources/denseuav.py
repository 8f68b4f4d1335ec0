"""DenseUAV as its authors lay it out on disk -> ImageRecords.

`train/{drone,satellite}/<location>/` and `test/{query,gallery}_{drone,satellite}/<location>/` hold `H80.JPG` and the like from
three heights, and the satellite images that go with them, `H80.tif` and the older `H80_old.tif`. `Dense_GPS_train.txt`,
`Dense_GPS_test.txt` and `Dense_GPS_ALL.txt` at the root say where: `path E120.38 N30.32 94.6`, or latitude before longitude
where there are no letters.

A table names some images of a location only, and its official evaluation takes one position for all
of them; so an image without a line has its location's position. A drone image's height is that of
its own line, else the nominal one of its name.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import GeoTag, ImageRecord, Rejection, View
from pipeline.sources.base import Source
from pipeline.sources.folders import LocatedImage, SplitFolder, images_by_split, require_images
from pipeline.sources.text_tables import (
    Unreadable,
    parse_number,
    parse_position,
    read_lines,
    unreadable_tag_row,
)

LAYOUT = (
    "DenseUAV's root, which holds train/{drone,satellite}/<location>/ and "
    "test/{query,gallery}_{drone,satellite}/<location>/"
)
TABLES = ("Dense_GPS_train.txt", "Dense_GPS_test.txt", "Dense_GPS_ALL.txt")
VALUE_PATTERN = r"[NSEW]?[-+\d.]\S*"
LINE_PATTERN = re.compile(
    rf"(?P<path>\S.*\.(?:jpe?g|png|tiff?))\s+(?P<first>{VALUE_PATTERN})\s+(?P<second>{VALUE_PATTERN})\s+(?P<height>\S+)",
    re.IGNORECASE,
)
HEIGHT_PATTERN = re.compile(r"H(\d+)", re.IGNORECASE)


@dataclass(frozen=True, kw_only=True)
class DenseUAV(Source):
    """DenseUAV, official layout."""

    def scan(self, root: str) -> Iterator[ImageRecord | Rejection]:
        return require_images(self._scan(root), root, LAYOUT)

    def _scan(self, root: str) -> Iterator[ImageRecord | Rejection]:
        tags, rejected = read_geotags(root)
        yield from rejected
        yield from images_by_split(
            root, (View.DRONE, View.SATELLITE), lambda folder, image: _tag(image, folder, tags)
        )


def _tag(image: LocatedImage, folder: SplitFolder, tags: dict[str, GeoTag]) -> GeoTag | None:
    own = tags.get(f"{folder.phase}/{folder.folder}/{image.location}/{image.name}")
    tag = own or tags.get(f"{folder.phase}/{image.location}") or tags.get(image.location)
    if tag is None:
        return None
    nominal = HEIGHT_PATTERN.match(image.name)
    if (
        folder.view != View.DRONE
    ):  # the tables give the drone's height with the satellite image's name
        return replace(tag, altitude_m=None)
    return tag if own else replace(tag, altitude_m=float(nominal[1]) if nominal else None)


def read_geotags(root: str) -> tuple[dict[str, GeoTag], list[Rejection]]:
    """Geotags by path below the root, by phase and location, and by location; the first line that
    names one counts.

    Raises InputError when not one line of a table can be read.
    """
    tags: dict[str, GeoTag] = {}
    rejected: list[Rejection] = []
    for table in TABLES:
        path = storage.join(root, table)
        if not storage.exists(path):
            continue
        refused, read = [], 0
        for line_number, line in read_lines(path):
            try:
                named, tag = parse_line(line)
            except Unreadable as error:
                refused.append(unreadable_tag_row(path, line_number, line, error))
                continue
            read += 1
            parts = named.replace("\\", "/").split("/")[-4:]
            tags.setdefault("/".join(parts), tag)
            if len(parts) == 4:
                tags.setdefault(f"{parts[0]}/{parts[2]}", tag)
            if len(parts) > 1:
                tags.setdefault(parts[-2], tag)
        if refused and not read:
            raise InputError(
                f"{path} has no line that can be read ({refused[0].found}); expected `path E<longitude> N<latitude> "
                "<height>`; mend it or take it away"
            )
        rejected += refused
    return tags, rejected


def parse_line(line: str) -> tuple[str, GeoTag]:
    """`train/satellite/000001/H80.tif E120.387 N30.32 94.6` -> path and geotag; the letters, where
    there are some, say which is which and which half of the earth.

    Raises Unreadable.
    """
    match = LINE_PATTERN.fullmatch(line.strip())
    if match is None:
        raise Unreadable("expected path, longitude, latitude and height")
    named = {
        value[0].upper() if value[0].isalpha() else "": value
        for value in (match["first"], match["second"])
    }
    lat = named.get("N") or named.get("S")
    lon = named.get("E") or named.get("W")
    if lat is None and lon is None and set(named) == {""}:
        lat, lon = match["first"], match["second"]
    if lat is None or lon is None:
        raise Unreadable(
            "expected one latitude with N or S and one longitude with E or W, or no letters"
        )
    north, east = parse_position(lat.lstrip("NSns"), lon.lstrip("EWew"))
    altitude = parse_number(match["height"])
    return match["path"], GeoTag(
        lat=-north if lat[0] in "Ss" else north,
        lon=-east if lon[0] in "Ww" else east,
        altitude_m=altitude,
    )
