"""Text tables of the positions at which images were taken -> rows, checked numbers, geotags.

In: a CSV or text file on any storage. Out: rows with their line numbers, and coordinates within
range. A line that cannot be read becomes a Rejection of its own (`unreadable_tag_row`), and its
images go on without a geotag.
"""

import csv
import io
import math
import re
from collections.abc import Iterable, Iterator

import numpy as np

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.geo import haversine_m
from pipeline.core.records import MAX_EXCERPT_LENGTH, GeoTag, Rejection

NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?", re.ASCII)
"""Matches a number in one way only: a pattern that matches in two ways takes time that grows with
the square of a long cell's length to refuse it."""
SAME_POSITION_M = 10.0
"Two statements of one position that are further apart contradict each other."


class Unreadable(ValueError):
    """A value that cannot be used; the message says what was found and what was expected."""


def parse_number(text: str) -> float:
    """Raises Unreadable for text that is not a finite number, such as nan and inf."""
    value = float(text) if NUMBER.fullmatch(text.strip()) else math.nan
    if not math.isfinite(value):
        raise Unreadable(f"{text!r} is not a finite number")
    return value


def parse_optional_number(text: str) -> float | None:
    """None for an empty cell. Raises Unreadable."""
    return parse_number(text) if text.strip() else None


def parse_position(lat: str, lon: str) -> tuple[float, float]:
    """Latitude and longitude, degrees. Raises Unreadable."""
    north, east = parse_number(lat), parse_number(lon)
    if abs(north) > 90:
        raise Unreadable(f"latitude {north:g} is not between -90 and 90")
    if abs(east) > 180:
        raise Unreadable(f"longitude {east:g} is not between -180 and 180")
    return north, east


def distance_m(one: tuple[float, float], other: tuple[float, float]) -> float:
    """Metres between two positions, (lat, lon)."""
    return float(haversine_m(np.array(one), np.array(other)))


class TagTable:
    """Geotags by name, collected from tables that may state a name twice.

    A name that was given positions more than SAME_POSITION_M apart has no geotag: it is unknown
    which of them is right, and a wrong position is worse than none.
    """

    def __init__(self) -> None:
        self._tags: dict[str, GeoTag | None] = {}

    def add(self, name: str, tag: GeoTag) -> None:
        """Keep the first statement of a name. Raises Unreadable where this one contradicts it."""
        known = self._tags.setdefault(name, tag)
        if known is None or known is tag:
            return
        apart = distance_m((known.lat, known.lon), (tag.lat, tag.lon))
        if apart > SAME_POSITION_M:
            self._tags[name] = None
            raise Unreadable(
                f"{name} is at {tag.lat:g}, {tag.lon:g} here and {apart:,.0f} m away, at "
                f"{known.lat:g}, {known.lon:g}, elsewhere; it has no position now"
            )

    def add_default(self, name: str, tag: GeoTag) -> None:
        """A tag for a group of images whose positions differ by nature; the first one is kept."""
        self._tags.setdefault(name, tag)

    def find(self, *names: str) -> GeoTag | None:
        """The geotag of the first of these names that is known."""
        return next((self._tags[name] for name in names if name in self._tags), None)

    def __contains__(self, name: str) -> bool:
        return name in self._tags


def read_lines(path: str) -> Iterator[tuple[int, str]]:
    """The lines that are not blank, with their numbers from 1. Characters that are not UTF-8
    become question marks: numbers survive that, and a name that does not matches no image.
    """
    text = storage.read_bytes(path).decode("utf-8-sig", errors="replace")
    return ((number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip())


def read_rows(path: str, columns: Iterable[str]) -> Iterator[tuple[int, dict[str, str]]]:
    """Rows of a CSV by column name, with the numbers of their lines; a missing cell is empty.

    Raises InputError when a column of `columns` is missing or the file is not a table.
    """
    text = storage.read_bytes(path).decode("utf-8-sig", errors="replace")
    reader = csv.reader(io.StringIO(text, newline=""))
    try:
        header = [name.strip() for name in next(reader, [])]
        missing = [name for name in columns if name not in header]
        if missing:
            found = ", ".join(header)[:MAX_EXCERPT_LENGTH] or "nothing"
            raise InputError(
                f"{path} has no column {', '.join(missing)}, its first line holds {found}; "
                "correct it or take it away"
            )
        for row in reader:
            if any(cell.strip() for cell in row):
                cells = row + [""] * (len(header) - len(row))
                yield reader.line_num, dict(zip(header, cells, strict=False))
    except csv.Error as error:
        raise InputError(
            f"{path} cannot be read as a table ({error}); correct it or take it away"
        ) from None


def unreadable_tag_row(path: str, line: int, text: str, cause: object) -> Rejection:
    """A line of a table that gives no geotag."""
    found = f"line {line}: {text[:MAX_EXCERPT_LENGTH]}: {cause}"
    return Rejection(path=path, reason="unreadable tag", found=found)
