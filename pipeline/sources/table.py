"""A table of images -> ImageRecords: for imagery that lies as it lies, and whose facts somebody has
already.

In: a CSV, Parquet or GeoJSON file. Out: a record per row, in the table's order; a Rejection with
the row's number for each row that cannot be one.
"""

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date, datetime
from typing import Any

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import GeoTag, ImageRecord, Rejection, Split, View
from pipeline.images.camera_position import parse_number, validate_position
from pipeline.images.image_blocks import UnreadableTag
from pipeline.images.inspect import is_image_name
from pipeline.sources.base import Source
from pipeline.sources.maps.geojson_shapes import Shape, order_footprint, wrap_longitude
from pipeline.sources.table_rows import BROKEN_COLUMN, SHAPE_COLUMN, Row, read_table_rows


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
        for row_number, row in read_table_rows(root):
            empty = False
            path = _cell_text(row, "path")
            whole = path if path.startswith("/") or "://" in path else storage.join(folder, path)
            try:
                yield self._record(row, path, whole)
            except BadRow as bad:
                said = whole if path else root
                yield Rejection(
                    path=said, reason=bad.reason, found=f"row {row_number}: {bad.found}"
                )
        if empty:
            raise InputError(f"{root} has no rows; expected one per image")

    def _record(self, row: Row, path: str, whole: str) -> ImageRecord:
        """Raises BadRow."""
        if BROKEN_COLUMN in row:
            raise BadRow(*row[BROKEN_COLUMN])
        if not path:
            raise BadRow("missing path", "no path")
        name = path.rpartition("/")[2]
        if not is_image_name(name):
            raise BadRow("not an image's name", name)
        view, split = (
            _cell_text(row, "view").lower() or self.view,
            _cell_text(row, "split").lower() or self.split,
        )
        if view not in set(View):
            raise BadRow("unknown view", f"{view}, not one of {', '.join(View)}")
        if split not in set(Split):
            raise BadRow("unknown split", f"{split}, not one of {', '.join(Split)}")
        return ImageRecord(
            path=whole,
            view=View(view),
            split=Split(split),
            location=_cell_text(row, "location") or name.rpartition(".")[0],
            geotag=geotag_of_row(row),
            taken_at=_taken_at(row),
            bytes=_file_size(whole),
        )


class BadRow(ValueError):
    """A row that is no image. `reason` is short and countable."""

    def __init__(self, reason: str, found: str) -> None:
        super().__init__(f"{reason}: {found}")
        self.reason, self.found = reason, found


def geotag_of_row(row: Row) -> GeoTag | None:
    """The geotag of a row; None where it has no position, or exactly 0, 0.

    Of a polygon the position is its centroid, and with four corners they are the footprint of an
    image whose top looks in the direction of the row's heading, north where it has none. Raises
    BadRow.
    """
    shape: Shape | None = row.get(SHAPE_COLUMN)
    if shape is None:
        said = f"lat {row.get('lat')}, lon {row.get('lon')}"
        place = (_cell_number(row, "lat"), _cell_number(row, "lon"))
    else:
        said, place = shape.found, shape.middle or (None, None)
    lat, lon = place
    altitude, heading, pitch = (
        _cell_number(row, name) for name in ("altitude_m", "heading_deg", "pitch_deg")
    )
    if pitch is not None and abs(pitch) > 90:
        raise BadRow("unreadable tag", f"pitch_deg {pitch}, not from -90 to 90")
    if shape is None and lat is None and lon is None:
        return None
    if lat is None or lon is None:
        raise BadRow("unreadable tag", said)
    try:
        found = validate_position(lat, lon, "position" if shape is None else shape.found)
        corners = shape.corners if shape is not None else ()
        for corner in corners:
            validate_position(corner[0], wrap_longitude(corner[1]), "corner of a polygon")
    except UnreadableTag as error:
        raise BadRow("unreadable tag", str(error)) from None
    return (
        None
        if found is None
        else GeoTag(
            lat=found[0],
            lon=found[1],
            altitude_m=altitude,
            heading_deg=None if heading is None else heading % 360,
            pitch_deg=pitch,
            footprint=order_footprint(corners, heading or 0.0) if corners else None,
        )
    )


def _cell_text(row: Row, name: str) -> str:
    value = row.get(name)
    return (
        "" if value is None or value != value else str(value).strip()
    )  # NaN: how pandas writes nothing


def _cell_number(row: Row, name: str) -> float | None:
    """None where the cell is empty, null or NaN. Raises BadRow."""
    text = _cell_text(row, name)
    if not text or text.lower() == "nan":
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
    """Bytes of a file on this machine; None elsewhere, where asking takes a request each. Raises
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
