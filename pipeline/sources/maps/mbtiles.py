"""MBTiles: a pyramid of tiles in one SQLite file. In: its path. Out: which tiles it holds, and
their bytes.

Every call opens the file for itself, read-only: that takes a tenth of a millisecond, and threads
and processes share nothing.
"""

import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from urllib.parse import quote

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import Rejection
from pipeline.sources.maps.web_mercator import MAX_ZOOM, flip_row

VECTOR_FORMATS = ("pbf", "mvt")
MAGIC_BYTES = 12  # bytes from which `kind_of` knows an image
FROM_TILE = "FROM tiles WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?"
MAX_VALUE_BYTES = 1 << 26
"Bytes of any value: what SQLite would make of `zeroblob(1e9)` in a view is no tile."
QUERY_TIMEOUT_S = 600.0
"""Seconds without a row until a query is given up: `tiles` may be a view, and a view may have no
end."""
STEPS_PER_CHECK = 1_000_000
"Of SQLite's machine between two looks at the clock (and at Ctrl-C): some milliseconds."
ALLOWED_ACTIONS = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_FUNCTION)
"""What a query of ours, and the views behind it, may do. Recursion is not among it: it may go on
for ever."""


@dataclass(frozen=True, kw_only=True)
class StoredTile:
    """One row of the table."""

    x: int
    y: int
    "Row from the north, as XYZ counts, whatever the file does."
    kind: str
    "Its ending by its first bytes; empty where they are no image's."
    start: bytes
    "Those first bytes."


def list_zooms(path: str) -> list[int]:
    """Zooms that the file holds, ascending.

    Raises InputError when it is no MBTiles file of images on this machine.
    """
    if not storage.is_local(path):
        raise InputError(
            f"{path} is not on this machine; SQLite reads local files alone: copy it to a disk here"
        )
    with _connect(path) as database:
        form = _metadata(database).get("format", "")
        if form in VECTOR_FORMATS:
            raise InputError(
                f"{path} holds vector tiles ({form}), which show no pixels; expected png, jpg or webp tiles"
            )
        found = [
            zoom
            for (zoom,) in database.execute(
                "SELECT DISTINCT zoom_level FROM tiles ORDER BY zoom_level"
            )
        ]
        return [zoom for zoom in found if isinstance(zoom, int) and 0 <= zoom <= MAX_ZOOM]


def list_tiles(path: str, zoom: int) -> Iterator[StoredTile | Rejection]:
    """Every tile of one zoom, by column and row; a Rejection for one whose column or row is no
    whole number.

    Raises InputError when it finds vector tiles, or the file is damaged.
    """
    query = f"SELECT tile_column, tile_row, substr(tile_data, 1, {MAGIC_BYTES}) FROM tiles WHERE zoom_level = ? ORDER BY 1, 2"
    with _connect(path) as database:
        from_north = _metadata(database).get("scheme") == "xyz"
        for x, row, start in database.execute(query, (zoom,)):
            database.waits_since = time.monotonic()
            if not (isinstance(x, int) and isinstance(row, int)):
                yield Rejection(
                    path=f"{path}#{zoom}",
                    reason="outside of the map",
                    found=f"column {x!r}, row {row!r}",
                )
                continue
            start = start if isinstance(start, bytes) else b""
            if start[:2] == b"\x1f\x8b":  # only vector tiles are packed with gzip
                raise InputError(
                    f"{path} holds vector tiles (gzip), which show no pixels; expected png, jpg or webp tiles"
                )
            yield StoredTile(
                x=x,
                y=row if from_north else flip_row(zoom, row),
                kind=image_format(start),
                start=start,
            )


def read_tile(path: str, zoom: int, x: int, y: int) -> bytes:
    """A tile's own bytes; `y` from the north. Raises OSError when it is not there."""
    return _read_value(path, "tile_data", zoom, x, y)


def read_tile_format(path: str, zoom: int, x: int, y: int) -> str:
    """A tile's ending by its first bytes; `y` from the north. Raises OSError when it is not there."""
    return image_format(_read_value(path, f"substr(tile_data, 1, {MAGIC_BYTES})", zoom, x, y))


def image_format(start: bytes) -> str:
    """png, jpg or webp by an image's first 12 bytes; else empty."""
    if start.startswith(b"\x89PNG"):
        return "png"
    if start.startswith(b"\xff\xd8\xff"):
        return "jpg"
    return "webp" if start[:4] == b"RIFF" and start[8:12] == b"WEBP" else ""


def _read_value(path: str, what: str, zoom: int, x: int, y: int) -> bytes:
    try:
        with _connect(path) as database:
            from_north = _metadata(database).get("scheme") == "xyz"
            row = database.execute(
                f"SELECT {what} {FROM_TILE}", (zoom, x, y if from_north else flip_row(zoom, y))
            ).fetchone()
    except InputError as error:  # it could be read when it was scanned
        raise OSError(str(error)) from None
    if row is None or not isinstance(row[0], bytes):
        raise OSError(f"no tile {zoom}/{x}/{y} in {path}")
    return row[0]


class _BoundedConnection(sqlite3.Connection):
    """Of a file that anybody may have written: it reads, in bounded time and memory."""

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
    """A connection that cannot write. Raises InputError when the file is no MBTiles, whenever that
    shows.
    """
    inner = storage.resolve(path)[1]
    try:
        with closing(
            sqlite3.connect(f"file:{quote(inner)}?mode=ro", uri=True, factory=_BoundedConnection)
        ) as database:
            database.bound()
            yield database
    except sqlite3.Error as error:
        raise InputError(
            f"{path} cannot be read as MBTiles ({error}); mend it or take another file"
        ) from None


def _metadata(database: sqlite3.Connection) -> dict[str, str]:
    """The table of that name; empty where there is none, which the specification forbids and some
    writers do.
    """
    if not database.execute("SELECT 1 FROM sqlite_master WHERE name = 'metadata'").fetchone():
        return {}
    return dict(database.execute("SELECT name, value FROM metadata"))
