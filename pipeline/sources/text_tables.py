"""Text tables that say where images were taken -> their rows and checked numbers.

In: a CSV or text file on any storage. Out: rows with their line numbers, and coordinates that are
on the earth. What cannot be read in one line is that line's fault alone: `unreadable_tag_row` tells it,
and the image goes on without a tag.
"""

import csv
import io
import math
import re
from collections.abc import Iterable, Iterator

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import MAX_EXCERPT_LENGTH, Rejection

NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?", re.ASCII)
"In one way only: what could be matched in two takes the square of a long cell's length to refuse."


class Unreadable(ValueError):
    """A value that is not what it should be; the message says what was found and what was expected."""


def parse_number(text: str) -> float:
    """Raises Unreadable for whatever is no finite number, such as nan and inf."""
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


def read_lines(path: str) -> Iterator[tuple[int, str]]:
    """The lines that hold something, with their numbers from 1. Characters that are not UTF-8
    become question marks: numbers survive that, and a name that does not is the name of no image.
    """
    text = storage.read_bytes(path).decode("utf-8-sig", errors="replace")
    return ((place, line) for place, line in enumerate(text.splitlines(), 1) if line.strip())


def read_rows(path: str, columns: Iterable[str]) -> Iterator[tuple[int, dict[str, str]]]:
    """Rows of a CSV by column name, with the numbers of their lines; a cell that is not there is
    empty.

    Raises InputError when a column of `columns` is missing or the file is no table.
    """
    text = storage.read_bytes(path).decode("utf-8-sig", errors="replace")
    reader = csv.reader(io.StringIO(text, newline=""))
    try:
        header = [name.strip() for name in next(reader, [])]
        missing = [name for name in columns if name not in header]
        if missing:
            found = ", ".join(header)[:MAX_EXCERPT_LENGTH] or "nothing"
            raise InputError(
                f"{path} has no column {', '.join(missing)}, its first line holds {found}; mend it or take it away"
            )
        for row in reader:
            if any(cell.strip() for cell in row):
                yield (
                    reader.line_num,
                    dict(zip(header, row + [""] * (len(header) - len(row)), strict=False)),
                )
    except csv.Error as error:
        raise InputError(
            f"{path} cannot be read as a table ({error}); mend it or take it away"
        ) from None


def unreadable_tag_row(path: str, line: int, text: str, why: object) -> Rejection:
    """A line of a table that gives no geotag."""
    return Rejection(
        path=path, reason="unreadable tag", found=f"line {line}: {text[:MAX_EXCERPT_LENGTH]}: {why}"
    )
