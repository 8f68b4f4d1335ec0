"""A table of images -> ImageRecords: images in any folders whose metadata is in one file.

In: a CSV, Parquet or GeoJSON file. Out: a record per row, in the table's order; a Rejection with
the row's number for each row that cannot be one.
"""

import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date, datetime
from typing import Any

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import (
    MISSING_WORDS,
    GeoTag,
    ImageRecord,
    Rejection,
    Split,
    View,
)
from pipeline.images.camera_position import parse_number, validate_position
from pipeline.images.image_blocks import UnreadableTag
from pipeline.images.optional_formats import is_decodable_name, undecodable_format
from pipeline.sources.base import Source
from pipeline.sources.maps.geojson_shapes import Shape, order_footprint, wrap_longitude
from pipeline.sources.table_rows import BROKEN_COLUMN, SHAPE_COLUMN, Row, read_table_rows
from pipeline.sources.text_tables import distance_m

WHOLE_FLOAT = re.compile(r"(-?\d+)\.0+", re.ASCII)
"""A whole number that became a float, as pandas writes a column of numbers in which one is
missing."""
POINT_TOLERANCE_M, POLYGON_TOLERANCE_M = 100.0, 10_000.0
"""Distances that a row's `lat` and `lon` may have from its geometry. A polygon is the ground shown,
and `lat` and `lon` may be the camera's own position beside it."""


@dataclass(frozen=True, kw_only=True)
class Table(Source):
    """Images listed in a CSV, Parquet or GeoJSON file."""

    view: View = View.DRONE
    "View of the rows that name none."
    split: Split = Split.QUERY
    "Split of the rows that name none."

    def scan(self, root: str) -> Iterator[ImageRecord | Rejection]:
        folder = root.rpartition("/")[0] if "/" in root else "."
        empty = True
        for number, row in read_table_rows(root):
            empty = False
            path = _cell_text(row, "path")
            absolute = path.startswith("/") or "://" in path
            full_path = path if absolute else storage.join(folder, path)
            try:
                yield self._record(row, path, full_path)
            except BadRow as bad:
                yield Rejection(
                    path=full_path if path else root,
                    reason=bad.reason,
                    found=f"row {number}: {bad.found}",
                )
        if empty:
            raise InputError(f"{root} has no rows; expected one per image")

    def _record(self, row: Row, path: str, full_path: str) -> ImageRecord:
        """Raises BadRow."""
        if BROKEN_COLUMN in row:
            raise BadRow(*row[BROKEN_COLUMN])
        if not path:
            raise BadRow("missing path", "no path")
        name = path.rpartition("/")[2]
        if rejection := undecodable_format(name):
            raise BadRow(rejection.reason, rejection.found)
        if not is_decodable_name(name):
            raise BadRow("not an image's name", name)
        view = _cell_text(row, "view").lower() or self.view
        split = _cell_text(row, "split").lower() or self.split
        if view not in set(View):
            raise BadRow("unknown view", f"{view}, not one of {', '.join(View)}")
        if split not in set(Split):
            raise BadRow("unknown split", f"{split}, not one of {', '.join(Split)}")
        location = _cell_text(row, "location")
        if integer := WHOLE_FLOAT.fullmatch(location):
            location = integer[1]
        return ImageRecord(
            path=full_path,
            view=View(view),
            split=Split(split),
            location=location or name.rpartition(".")[0],
            geotag=geotag_of_row(row),
            taken_at=_taken_at(row),
            bytes=_file_size(full_path),
        )


class BadRow(ValueError):
    """A row that is not an image. `reason` is short and countable."""

    def __init__(self, reason: str, found: str) -> None:
        super().__init__(f"{reason}: {found}")
        self.reason, self.found = reason, found


def geotag_of_row(row: Row) -> GeoTag | None:
    """The geotag of a row; None where it has no position, or exactly 0, 0.

    The position of a polygon is its centroid; four corners are the footprint of an image whose top
    points in the direction of the row's heading, north where there is none. A geometry and a `lat`
    and `lon` that contradict it are refused. Raises BadRow.
    """
    shape: Shape | None = row.get(SHAPE_COLUMN)
    altitude, heading, pitch, roll, focal = (
        _cell_number(row, name)
        for name in ("altitude_m", "heading_deg", "pitch_deg", "roll_deg", "focal_35mm")
    )
    if pitch is not None and abs(pitch) > 90:
        raise BadRow("unreadable tag", f"pitch_deg {pitch}, not from -90 to 90")
    if focal is not None and focal <= 0:
        raise BadRow("unreadable tag", f"focal_35mm {focal}, not above 0")
    position = _position(row, "position") if shape is None else _middle(shape)
    if position is None:
        return None
    if shape is not None:
        _check_agreement(row, shape, position)
    return GeoTag(
        lat=position[0],
        lon=position[1],
        altitude_m=altitude,
        heading_deg=None if heading is None else heading % 360,
        pitch_deg=pitch,
        roll_deg=roll,
        focal_35mm=focal,
        footprint=order_footprint(shape.corners, heading or 0.0)
        if shape is not None and shape.corners
        else None,
    )


def _position(row: Row, name: str) -> tuple[float, float] | None:
    """The position of the columns `lat` and `lon`. Raises BadRow."""
    lat, lon = _cell_number(row, "lat"), _cell_number(row, "lon")
    if lat is None and lon is None:
        return None
    if lat is None or lon is None:
        raise BadRow("unreadable tag", f"lat {row.get('lat')}, lon {row.get('lon')}")
    return _validated(lat, lon, name)


def _middle(shape: Shape) -> tuple[float, float] | None:
    """Raises BadRow."""
    if shape.middle is None:
        raise BadRow("unreadable tag", shape.found)
    for lat, lon in shape.corners:
        _validated(lat, wrap_longitude(lon), "corner of a polygon")
    return _validated(*shape.middle, shape.found)


def _validated(lat: float, lon: float, name: str) -> tuple[float, float] | None:
    """Raises BadRow."""
    try:
        return validate_position(lat, lon, name)
    except UnreadableTag as error:
        raise BadRow("unreadable tag", str(error)) from None


def _check_agreement(row: Row, shape: Shape, position: tuple[float, float]) -> None:
    """Raises BadRow where a row's `lat` and `lon` contradict its geometry. Columns that cannot be
    read contradict nothing.
    """
    try:
        columns = _position(row, "position")
    except BadRow:
        return
    tolerance = POLYGON_TOLERANCE_M if shape.span else POINT_TOLERANCE_M
    if columns is None or (apart := distance_m(columns, position)) <= tolerance:
        return
    raise BadRow(
        "contradicting positions",
        f"{shape.found} and lat {columns[0]:g}, lon {columns[1]:g} are {apart:,.0f} m apart",
    )


def _cell_text(row: Row, name: str) -> str:
    """The text of a cell; empty where it holds a word for a missing value."""
    value = row.get(name)
    if value is None or value != value:  # NaN, which pandas writes for a missing value
        return ""
    text = str(value).strip()
    return "" if text.lower() in MISSING_WORDS else text


def _cell_number(row: Row, name: str) -> float | None:
    """None where the cell is empty. Raises BadRow."""
    text = _cell_text(row, name)
    if not text:
        return None
    value = parse_number(text)
    if value is None or not math.isfinite(value):
        raise BadRow("unreadable tag", f"{name} {text}")
    return value


def _taken_at(row: Row) -> str | None:
    value: Any = row.get("taken_at")
    if isinstance(value, date):  # a Parquet timestamp; datetimes are dates
        return value.isoformat()
    text = _cell_text(row, "taken_at")
    try:
        return datetime.fromisoformat(text).isoformat() if text else None
    except ValueError:
        raise BadRow("unreadable tag", f"taken_at {text}, not ISO 8601") from None


def _file_size(path: str) -> int | None:
    """Bytes of a file on this machine; None of a remote one, as each would cost a request. Raises
    BadRow.
    """
    if "://" in path and not path.startswith("file://"):
        try:
            storage.resolve(path)
        except InputError as error:
            raise BadRow("no such storage", str(error)) from None
        return None
    try:
        return os.stat(path.removeprefix("file://")).st_size
    except (OSError, ValueError):  # ValueError: a NUL in the name
        raise BadRow("no such file", path) from None
