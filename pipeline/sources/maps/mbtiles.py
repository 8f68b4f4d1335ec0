"""MBTiles: a pyramid of tiles in one SQLite file. In: its path. Out: its metadata, its tiles, their
bytes.

Rows are as the file counts them; `tile_metadata.choose_rows` finds out from which end. Numbers may
be stored as integers, floats or text: SQLite keeps what a writer gave it. Every call opens the file
again, read-only: that takes a tenth of a millisecond, and threads and processes share nothing.
"""

import re
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import Rejection

VECTOR_FORMATS = ("pbf", "mvt")
MAGIC_BYTES = 12  # bytes from which `image_format` recognises an image
ZOOM = "zoom_level IN (?, ?, ?)"
FROM_TILE = f"FROM tiles WHERE {ZOOM} AND tile_column IN (?, ?, ?) AND tile_row IN (?, ?, ?)"
"Each number is bound as an integer, which a float equals too, and as two texts."
MAX_VALUE_BYTES = 1 << 26
"Of any value: a view may compute `zeroblob(1e9)` as a tile."
QUERY_TIMEOUT_S = 600.0
"Seconds without a row until a query is given up: `tiles` may be a view, which may have no end."
STEPS_PER_CHECK = 1_000_000
"Steps of SQLite's machine, some milliseconds, between two checks of the clock (and of Ctrl-C)."
ALLOWED_ACTIONS = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_FUNCTION)
"""Actions of our queries, and of the views behind them. Recursion is not allowed: it may never
end."""
WHOLE_NUMBER = re.compile(r"(-?\d{1,18})(\.0)?", re.ASCII)


@dataclass(frozen=True, kw_only=True)
class StoredTile:
    """One row of the table."""

    x: int
    row: int
    "As the file counts."
    kind: str
    "Its ending by its first bytes; empty where they are not those of an image."
    start: bytes
    "Those first bytes."


def read_metadata(path: str) -> dict[str, str]:
    """The file's metadata by name.

    Raises InputError when the file is not an MBTiles file of images on this machine.
    """
    if not storage.is_local(path):
        raise InputError(
            f"{path} is not on this machine; SQLite reads local files alone: copy it to a disk here"
        )
    with _connect(path) as database:
        # The specification requires the table, and some writers omit it.
        if not database.execute("SELECT 1 FROM sqlite_master WHERE name = 'metadata'").fetchone():
            return {}
        rows = database.execute("SELECT name, value FROM metadata")
        metadata = {str(name): str(value) for name, value in rows if value is not None}
    kind = metadata.get("format", "")
    if kind in VECTOR_FORMATS:
        raise InputError(
            f"{path} holds vector tiles ({kind}), which show no pixels; expected png, jpg or webp "
            "tiles"
        )
    return metadata


def count_zooms(path: str) -> dict[Any, int]:
    """Tiles by zoom, as it is stored: a number that is no whole number is not a zoom."""
    with _connect(path) as database:
        counts: dict[Any, int] = {}
        rows = database.execute("SELECT zoom_level, count(*) FROM tiles GROUP BY zoom_level")
        for zoom, count in rows:
            number = whole_number(zoom)
            key = zoom if number is None else number
            counts[key] = counts.get(key, 0) + count
    return counts


def count_tiles_within(path: str, zoom: int, area: tuple[int, int, int, int] | None) -> int:
    """How many tiles of a zoom there are, or lie in columns and rows from first to last."""
    query = f"SELECT count(*) FROM tiles WHERE {ZOOM}"
    values: list[Any] = [*_spellings(zoom)]
    if area is not None:
        for column in ("tile_column", "tile_row"):
            query += f" AND CAST({column} AS INTEGER) BETWEEN ? AND ?"
        values += area
    with _connect(path) as database:
        count: int = database.execute(query, values).fetchone()[0]
    return count


def list_tiles(path: str, zoom: int) -> Iterator[StoredTile | Rejection]:
    """Every tile of one zoom, by column and row; a Rejection for one whose column or row is not a
    whole number.

    Raises InputError when it finds vector tiles, or the file is damaged.
    """
    query = (
        f"SELECT tile_column, tile_row, substr(tile_data, 1, {MAGIC_BYTES}) FROM tiles "
        f"WHERE {ZOOM} ORDER BY 1, 2"
    )
    with _connect(path) as database:
        for x, row, start in database.execute(query, _spellings(zoom)):
            database.waits_since = time.monotonic()
            column_number, row_number = whole_number(x), whole_number(row)
            if column_number is None or row_number is None:
                found = f"column {x!r}, row {row!r}"
                yield Rejection(path=f"{path}#{zoom}", reason="outside of the map", found=found)
                continue
            start = start if isinstance(start, bytes) else b""
            if start[:2] == b"\x1f\x8b":  # only vector tiles are packed with gzip
                raise InputError(
                    f"{path} holds vector tiles (gzip), which show no pixels; expected png, jpg or "
                    "webp tiles"
                )
            kind = image_format(start)
            yield StoredTile(x=column_number, row=row_number, kind=kind, start=start)


def read_tile(path: str, zoom: int, x: int, row: int) -> bytes:
    """A tile's own bytes. Raises OSError when there is no such tile."""
    return _read_value(path, "tile_data", zoom, x, row)


def read_tile_format(path: str, zoom: int, x: int, row: int) -> str:
    """A tile's ending by its first bytes. Raises OSError when there is no such tile."""
    return image_format(_read_value(path, f"substr(tile_data, 1, {MAGIC_BYTES})", zoom, x, row))


def image_format(start: bytes) -> str:
    """png, jpg or webp by an image's first 12 bytes; else empty."""
    if start.startswith(b"\x89PNG"):
        return "png"
    if start.startswith(b"\xff\xd8\xff"):
        return "jpg"
    return "webp" if start[:4] == b"RIFF" and start[8:12] == b"WEBP" else ""


def whole_number(value: Any) -> int | None:
    """A whole number stored as an integer, a float or text; None for anything else."""
    if isinstance(value, int):
        return value
    if isinstance(value, float):
        return int(value) if value.is_integer() else None
    match = WHOLE_NUMBER.fullmatch(value) if isinstance(value, str) else None
    return None if match is None else int(match[1])


def _spellings(number: int) -> tuple[int, str, str]:
    return number, str(number), f"{number}.0"


def _read_value(path: str, what: str, zoom: int, x: int, row: int) -> bytes:
    try:
        with _connect(path) as database:
            numbers = (*_spellings(zoom), *_spellings(x), *_spellings(row))
            found = database.execute(f"SELECT {what} {FROM_TILE}", numbers).fetchone()
    except InputError as error:  # the file was readable when it was scanned
        raise OSError(str(error)) from None
    if found is None or not isinstance(found[0], bytes):
        raise OSError(f"no tile {zoom}/{x}/{row} (zoom, column, row) in {path}")
    return found[0]


class _BoundedConnection(sqlite3.Connection):
    """Reads a file of unknown origin in bounded time and memory."""

    waits_since: float
    "When the last row came."

    def bound(self) -> None:
        self.waits_since = time.monotonic()
        self.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_VALUE_BYTES)
        self.set_authorizer(
            lambda action, *_: (
                sqlite3.SQLITE_OK if action in ALLOWED_ACTIONS else sqlite3.SQLITE_DENY
            )
        )
        self.set_progress_handler(
            lambda: time.monotonic() - self.waits_since > QUERY_TIMEOUT_S, STEPS_PER_CHECK
        )


@contextmanager
def _connect(path: str) -> Iterator[_BoundedConnection]:
    """A connection that cannot write. Raises InputError when the file is not MBTiles, at whatever
    query that shows.
    """
    inner = storage.resolve(path)[1]
    uri = f"file:{quote(inner)}?mode=ro"
    try:
        with closing(sqlite3.connect(uri, uri=True, factory=_BoundedConnection)) as database:
            database.bound()
            yield database
    except sqlite3.Error as error:
        raise InputError(
            f"{path} cannot be read as MBTiles ({error}); repair it or take another file"
        ) from None
