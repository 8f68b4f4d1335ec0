"""Small tile folders and MBTiles files for tests."""

import io
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipeline.core.records import ImageRecord, Rejection
from pipeline.sources.xyz import Xyz

EDGE = 85.0511287798066  # degrees: atan(sinh(pi)), where the square map ends


def tile(number: int = 0, kind: str = "PNG") -> bytes:
    stream = io.BytesIO()
    Image.fromarray(np.full((8, 8, 3), number, np.uint8)).save(stream, kind)
    return stream.getvalue()


def folder(root: Path, *names: str) -> str:
    for number, name in enumerate(names):
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        ending = name.rsplit(".", 1)[-1].lower()
        path.write_bytes(tile(number, {"png": "PNG", "webp": "WEBP"}.get(ending, "JPEG")))
    return str(root)


def mbtiles(
    path: Path, tiles: dict[tuple[Any, Any, Any], bytes], types: bool = True, **metadata: str
) -> str:
    """An MBTiles file of (zoom, column, row) -> bytes, rows as the file counts them. `types`:
    whether its columns declare types.
    """
    columns = {"zoom_level": "integer", "tile_column": "integer", "tile_row": "integer"}
    columns |= {"tile_data": "blob"}
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE metadata (name text, value text)")
        declared = ", ".join(f"{name} {kind if types else ''}" for name, kind in columns.items())
        database.execute(f"CREATE TABLE tiles ({declared})")
        database.executemany("INSERT INTO metadata VALUES (?, ?)", list(metadata.items()))
        database.executemany(
            "INSERT INTO tiles VALUES (?, ?, ?, ?)",
            [(*where, data) for where, data in tiles.items()],
        )
    return str(path)


def records(root: str, **settings: Any) -> dict[str, ImageRecord]:
    """By location; fails where anything is refused."""
    found = list(Xyz(**settings).scan(root))
    assert not [one for one in found if isinstance(one, Rejection)]
    return {record.location: record for record in found if isinstance(record, ImageRecord)}
