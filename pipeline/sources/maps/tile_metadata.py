"""Metadata of a tile set -> its row order, bounds and grid, compared with its tiles.

In: the metadata of an MBTiles file, or the files that tools write beside a tile folder
(`tilemapresource.xml` of gdal2tiles, `metadata.json` of mb-util, TileJSON). Out: whether rows count
from the north. Row order is the most common fault of tile sets: MBTiles count from the south, many
programs write them from the north, and some state the order that they do not have. A wrong order
mirrors the map at the equator, so the bounds, which state the position again, decide.
"""

import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.progress import console
from pipeline.sources.maps.bounded_xml import UnusableXml, elements, parse_xml
from pipeline.sources.maps.web_mercator import MERCATOR_HALF_M, row_of_latitude

Rows = Literal["auto", "north", "south"]
ROW_WORDS: dict[str, Rows] = {
    "xyz": "north", "osm": "north", "google": "north", "slippy": "north", "wmts": "north",
    "tms": "south",
}  # fmt: skip
ROW_KEYS = ("scheme", "tile_row_type")
GRID_KEYS = ("crs", "srs", "profile", "projection")
MERCATOR_WORDS = ("3857", "3785", "900913", "41001", "102100", "102113", "mercator")
"Names of web maps' grid."
MAX_METADATA_BYTES = 1 << 24
METADATA_FILES = ("metadata.json", "tiles.json", "tilejson.json")
TILE_MAP = "tilemapresource.xml"

Bounds = tuple[float, float, float, float]
"West, south, east, north, degrees."


@dataclass(frozen=True, kw_only=True)
class TileMetadata:
    """The statements of one file."""

    source: str
    "The file, for messages."
    rows: Rows = "auto"
    "auto: not stated."
    bounds: tuple[Bounds, ...] = ()
    "Readings of the bounds; more than one where programs disagree on their order."


def parse_metadata(source: str, values: Mapping[str, Any]) -> TileMetadata:
    """The statements of metadata by names. Raises InputError where the grid is not web maps'."""
    for key in GRID_KEYS:
        check_grid(source, key, str(values.get(key) or ""))
    words = [str(values.get(key) or "").strip().lower() for key in ROW_KEYS]
    rows: Rows = next((ROW_WORDS[word] for word in words if word in ROW_WORDS), "auto")
    found = values.get("bounds")
    parts = found.split(",") if isinstance(found, str) else found
    bounds = _readings(parts) if isinstance(parts, list) else ()
    return TileMetadata(source=source, rows=rows, bounds=bounds)


def check_grid(source: str, key: str, stated: str) -> None:
    """Raises InputError where a statement names another grid than that of web maps."""
    if stated and not any(word in stated.lower() for word in MERCATOR_WORDS):
        raise InputError(
            f"{source} states {key} {stated[:80]}; expected tiles on the grid of web maps "
            "(EPSG:3857): tiles of another grid would be placed wrong; make them again with "
            "gdal2tiles --profile=mercator"
        )


def read_folder_metadata(root: str, files: Iterable[str]) -> list[TileMetadata]:
    """The statements of the files at the root of a tile folder. Raises InputError."""
    there = {path.lower(): path for path in files if "/" not in path}
    found = []
    if TILE_MAP in there:
        found.append(_tile_map(storage.join(root, there[TILE_MAP])))
    for name in METADATA_FILES:
        if name not in there:
            continue
        path = storage.join(root, there[name])
        try:
            values = json.loads(storage.read_head(path, MAX_METADATA_BYTES).decode("utf-8-sig"))
        except (ValueError, RecursionError):
            console.print(f"{path} is not JSON and states nothing", markup=False)
            continue
        if isinstance(values, dict):
            found.append(parse_metadata(path, values))
    return found


def choose_rows(
    name: str,
    asked: Rows,
    usual: Rows,
    metadata: list[TileMetadata],
    zoom: int,
    count: Callable[[Rows, Bounds | None], int],
) -> Rows:
    """Whether rows count from the north or from the south, `north` or `south`.

    In this order: `asked`, a flag; the bounds, where tiles lie in them in one order alone; the
    order that the metadata states; the `usual` order. `count` returns how many tiles of `zoom` lie
    in bounds in a row order. Raises InputError where no tile lies in the bounds in either order,
    and where files contradict each other and no bounds decide.
    """
    stated = {one.rows: one.source for one in metadata if one.rows != "auto"}
    boxes = [(bounds, one.source) for one in metadata for bounds in one.bounds]
    other: dict[Rows, Rows] = {"north": "south", "south": "north"}
    if asked != "auto":
        inside = max((count(asked, bounds) for bounds, _ in boxes), default=1)
        if not inside:
            console.print(
                f"{name}: with rows from the {asked}, as asked, no tile lies in the bounds that "
                f"{boxes[0][1]} states",
                markup=False,
            )
        return asked
    expected = next(iter(stated)) if len(stated) == 1 else usual
    votes = [
        (count(expected, bounds), count(other[expected], bounds), bounds, source)
        for bounds, source in boxes
    ]
    best = max(votes, key=lambda vote: max(vote[:2]), default=None)
    if best is None or best[0] == best[1] != 0:  # no bounds, or bounds over both hemispheres
        if len(stated) > 1:
            files = " and ".join(f"{source} (from the {rows})" for rows, source in stated.items())
            raise InputError(
                f"{name}: {files} contradict each other in the order of rows, and no bounds "
                "decide; say --rows north or --rows south"
            )
        return expected
    inside, outside, bounds, source = best
    if not inside and not outside:
        raise InputError(
            f"{name}: no tile of zoom {zoom} lies in the bounds {_text(bounds)} that {source} "
            "states, with rows from the north or from the south; correct the bounds, or say --rows "
            "north or --rows south"
        )
    rows, most = (expected, inside) if inside > outside else (other[expected], outside)
    if rows != expected:
        console.print(
            f"{name}: rows count from the {rows}, by the bounds {_text(bounds)} of {source}; "
            f"from the {expected} the tiles would lie outside of them",
            markup=False,
        )
    total = count(rows, None)
    if most < total / 2:
        console.print(
            f"{name}: {most:,} of {total:,} tiles lie in the bounds {_text(bounds)} of {source}",
            markup=False,
        )
    return rows


def tile_range(zoom: int, bounds: Bounds, rows: Rows) -> tuple[int, int, int, int]:
    """First and last column, first and last row (as `rows` counts) of the tiles that overlap
    bounds.
    """
    west, south, east, north = bounds
    side = 1 << zoom
    if west > east:  # over the date line: any column
        west, east = -180.0, 180.0
    columns = (math.floor((lon + 180) / 360 * side) for lon in (west, east))
    left, right = columns
    top, bottom = row_of_latitude(zoom, north), row_of_latitude(zoom, south)
    if rows == "south":
        top, bottom = side - 1 - bottom, side - 1 - top
    return left, right, top, bottom


def _tile_map(path: str) -> TileMetadata:
    """TMS: rows from the south. Raises InputError where its grid is not web maps'."""
    try:
        root = parse_xml(storage.read_head(path, MAX_METADATA_BYTES))
    except UnusableXml as error:
        console.print(f"{path} states nothing: {error}", markup=False)
        return TileMetadata(source=path)
    for element in elements(root, "TileSets"):
        check_grid(path, "profile", element.get("profile", ""))
    for element in elements(root, "SRS"):
        check_grid(path, "SRS", (element.text or "").strip())
    bounds: tuple[Bounds, ...] = ()
    for element in elements(root, "BoundingBox"):
        bounds += _readings([element.get(name) for name in ("minx", "miny", "maxx", "maxy")])
    return TileMetadata(source=path, rows="south", bounds=bounds)


def _readings(values: list[Any]) -> tuple[Bounds, ...]:
    """Bounds by either order of coordinates: early gdal2tiles wrote latitudes as x, and users of
    go-tilepacks give them so.
    """
    if len(values) != 4:
        return ()
    west, south, east, north = values
    boxes = (_bounds([west, south, east, north]), _bounds([south, west, north, east]))
    return tuple(box for box in boxes if box is not None)


def _bounds(values: list[Any]) -> Bounds | None:
    """Bounds in degrees; None where they are none, or enclose nothing. Metres of EPSG:3857 are
    converted.
    """
    try:
        west, south, east, north = (float(value) for value in values)
    except (TypeError, ValueError):
        return None
    if not all(map(math.isfinite, (west, south, east, north))):
        return None
    if max(map(abs, (west, south, east, north))) > 360:
        if max(map(abs, (west, south, east, north))) > 1.01 * MERCATOR_HALF_M:
            return None
        west, east = (180 * x / MERCATOR_HALF_M for x in (west, east))
        south, north = (
            math.degrees(math.atan(math.sinh(math.pi * y / MERCATOR_HALF_M)))
            for y in (south, north)
        )
    if not (-90 <= south < north <= 90 and max(abs(west), abs(east)) <= 180 and west != east):
        return None
    return west, south, east, north


def _text(bounds: Bounds) -> str:
    return ", ".join(f"{value:g}" for value in bounds)
