"""Tables of images for tests, in every format."""

import json
from pathlib import Path
from typing import Any

from pipeline.core.records import ImageRecord, Rejection
from pipeline.sources.table import Table

SQUARE = [[8.0, 47.0], [8.2, 47.0], [8.2, 47.1], [8.0, 47.1], [8.0, 47.0]]
"Counter-clockwise from the south-west, longitude first, as RFC 7946 has it."


def images(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"12345")


def scan(
    path: Path, text: str | bytes | None = None, **changes: Any
) -> list[ImageRecord | Rejection]:
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return list(Table(**changes).scan(str(path)))


def only(found: list[ImageRecord | Rejection]) -> ImageRecord:
    [record] = found
    assert isinstance(record, ImageRecord), record
    return record


def geojson(path: Path, *features: tuple[Any, Any], **members: Any) -> Path:
    said = [
        {"type": "Feature", "geometry": geometry, "properties": properties}
        for geometry, properties in features
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": said} | members))
    return path
