"""DenseUAV as its authors distribute it -> ImageRecords.

`train/{drone,satellite}/<location>/` and `test/{query,gallery}_{drone,satellite}/<location>/` hold
`H80.JPG` and the like from three heights, and the satellite images of the same places, `H80.tif`
and the older `H80_old.tif`. `Dense_GPS_train.txt`, `Dense_GPS_test.txt` and `Dense_GPS_ALL.txt` at
the root give positions: `path E120.38 N30.32 94.6`, or latitude before longitude where there are no
letters.

A table names only some images of a location, and the official evaluation uses one position for all
of them; so an image without a line has its location's position. The height of a drone image is
that of its own line, else the nominal one of its name.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import GeoTag, Rejection, Scanned, View
from pipeline.sources.base import Source
from pipeline.sources.folders import LocatedImage, SplitFolder, images_by_split, require_images
from pipeline.sources.text_tables import (
    TagTable,
    Unreadable,
    parse_number,
    parse_position,
    read_lines,
    unreadable_tag_row,
)

_LAYOUT = (
    "DenseUAV's root, which holds train/{drone,satellite}/<location>/ and "
    "test/{query,gallery}_{drone,satellite}/<location>/"
)
TABLES = ("Dense_GPS_train.txt", "Dense_GPS_test.txt", "Dense_GPS_ALL.txt")
VALUE_PATTERN = r"[NSEW]?[-+\d.]\S*"
LINE_PATTERN = re.compile(
    r"(?P<path>\S.*\.(?:jpe?g|png|tiff?))\s+"
    rf"(?P<first>{VALUE_PATTERN})\s+(?P<second>{VALUE_PATTERN})\s+(?P<height>\S+)",
    re.IGNORECASE,
)
HEIGHT_PATTERN = re.compile(r"H(\d+)", re.IGNORECASE)


@dataclass(frozen=True, kw_only=True)
class DenseUAV(Source):
    """DenseUAV, official layout."""

    def scan(self, root: str) -> Iterator[Scanned]:
        return require_images(self._scan(root), root, _LAYOUT)

    def _scan(self, root: str) -> Iterator[Scanned]:
        tags, rejected = read_gps_tables(root)
        yield from rejected
        views = (View.DRONE, View.SATELLITE)
        yield from images_by_split(root, views, lambda folder, image: _tag(image, folder, tags))


def _tag(image: LocatedImage, folder: SplitFolder, tags: TagTable) -> GeoTag | None:
    path = f"{folder.phase}/{folder.folder}/{image.location}/{image.name}"
    tag = tags.find(path, f"{folder.phase}/{image.location}", image.location)
    if tag is None:
        return None
    if (
        folder.view != View.DRONE
    ):  # the tables give the drone's height with a satellite image's name
        return replace(tag, altitude_m=None)
    if path in tags:
        return tag
    nominal = HEIGHT_PATTERN.match(image.name)
    return replace(tag, altitude_m=float(nominal[1]) if nominal else None)


def read_gps_tables(root: str) -> tuple[TagTable, list[Rejection]]:
    """Geotags by path below the root, by phase and location, and by location; the lines that could
    not be read, or that contradict an earlier line for the same image.

    Raises InputError when not one line of a table can be read.
    """
    tags = TagTable()
    rejected: list[Rejection] = []
    for table in TABLES:
        path = storage.join(root, table)
        if not storage.exists(path):
            continue
        refused, read = [], 0
        for number, line in read_lines(path):
            try:
                named, tag = parse_line(line)
                read += 1
                parts = named.replace("\\", "/").split("/")[-4:]
                if len(parts) == 4:
                    tags.add_default(f"{parts[0]}/{parts[2]}", tag)
                if len(parts) > 1:
                    tags.add_default(parts[-2], tag)
                tags.add("/".join(parts), tag)
            except Unreadable as error:
                refused.append(unreadable_tag_row(path, number, line, error))
        if refused and not read:
            raise InputError(
                f"{path} has no line that can be read ({refused[0].found}); expected `path "
                "E<longitude> N<latitude> <height>`; correct it or take it away"
            )
        rejected += refused
    return tags, rejected


def parse_line(line: str) -> tuple[str, GeoTag]:
    """`train/satellite/000001/H80.tif E120.387 N30.32 94.6` -> path and geotag. Letters, where
    there are some, tell latitude from longitude and give the hemisphere.

    Raises Unreadable.
    """
    match = LINE_PATTERN.fullmatch(line.strip())
    if match is None:
        raise Unreadable("expected path, longitude, latitude and height")
    values = (match["first"], match["second"])
    by_letter = {value[0].upper() if value[0].isalpha() else "": value for value in values}
    lat = by_letter.get("N") or by_letter.get("S")
    lon = by_letter.get("E") or by_letter.get("W")
    if lat is None and lon is None and set(by_letter) == {""}:
        lat, lon = values
    if lat is None or lon is None:
        raise Unreadable(
            "expected one latitude with N or S and one longitude with E or W, or no letters"
        )
    north, east = parse_position(lat.lstrip("NSns"), lon.lstrip("EWew"))
    return match["path"], GeoTag(
        lat=-north if lat[0] in "Ss" else north,
        lon=-east if lon[0] in "Ww" else east,
        altitude_m=parse_number(match["height"]),
    )
