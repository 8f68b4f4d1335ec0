"""UAV-VisLoc's satellite maps -> their positions, and the tiles that are cut from them.

In: `satellite_coordinates_range.csv`, which gives the upper left and lower right corner of each
map, and the maps, `<NN>/satellite<NN>.tif`. One of them is too large for one file and comes as
`satellite<NN>_<row>-<column>.tif`, which share the corners of the entire map. Out: maps, tiles, and
a Rejection for each map that cannot be placed. Headers are read, no pixels.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import GeoTag, Rejection
from pipeline.sources.maps.mosaic import open_mosaic
from pipeline.sources.maps.tiles import Window, plan_tiles
from pipeline.sources.text_tables import Unreadable, parse_position, read_rows, unreadable_tag_row

RANGE_TABLES = ("satellite_coordinates_range.csv", "satellite_ coordinates_range.csv")
"The second, with a blank, is how the authors' archive spells it."
CORNER_COLUMNS = ("LT_lat_map", "LT_lon_map", "RB_lat_map", "RB_lon_map")
MAP_PART_PATTERN = re.compile(r"(?P<map>.+)_(?P<row>\d+)-(?P<column>\d+)")


@dataclass(frozen=True, kw_only=True)
class Corners:
    """A rectangle on the Earth, degrees."""

    top: float
    left: float
    bottom: float
    right: float

    def __post_init__(self) -> None:
        if not (self.top > self.bottom and self.right > self.left):
            raise Unreadable("the lower right corner is not south-east of the upper left one")

    def inside(self, y: float, x: float, y_end: float, x_end: float) -> "Corners":
        """The rectangle between two fractions of the height and of the width."""
        height, width = self.bottom - self.top, self.right - self.left
        return Corners(
            top=self.top + y * height,
            bottom=self.top + y_end * height,
            left=self.left + x * width,
            right=self.left + x_end * width,
        )

    def contains(self, lat: float, lon: float) -> bool:
        return self.bottom <= lat <= self.top and self.left <= lon <= self.right

    def tag(self) -> GeoTag:
        return GeoTag(
            lat=(self.top + self.bottom) / 2,
            lon=(self.left + self.right) / 2,
            footprint=(
                (self.top, self.left),
                (self.top, self.right),
                (self.bottom, self.right),
                (self.bottom, self.left),
            ),
        )


@dataclass(frozen=True, kw_only=True)
class SatelliteMap:
    """One file of a map with its position."""

    path: str
    name: str
    "The flight's, such as 01; of a part 09_01-02."
    width: int
    height: int
    corners: Corners

    def tiles(self, pixels: int, overlap: float) -> Iterator[tuple[str, Window, GeoTag]]:
        """Name, such as 01-0003-0012 for row 3 and column 12, window and geotag of each tile."""
        for tile in plan_tiles((self.width, self.height), (pixels, pixels), overlap):
            window = tile.window
            begin = window.y / self.height, window.x / self.width
            end = (window.y + window.height) / self.height, (window.x + window.width) / self.width
            name = f"{self.name}-{tile.row:04d}-{tile.column:04d}"
            yield name, window, self.corners.inside(*begin, *end).tag()


def map_name(name: str) -> str:
    """`satellite03.tif`, or `03.tif` as the authors' example has it -> `03`."""
    return name.strip().lower().rsplit(".", 1)[0].removeprefix("satellite")


def read_corners(root: str) -> tuple[dict[str, Corners], list[Rejection]]:
    """Corners by the map's name; of a map with two lines that differ, none.

    Raises InputError when there is no such table.
    """
    tables = (storage.join(root, table) for table in RANGE_TABLES)
    path = next(filter(storage.exists, tables), None)
    if path is None:
        raise InputError(
            f"no {RANGE_TABLES[0]} in {root}; expected UAV-VisLoc's root, which holds it; "
            "check --root"
        )
    corners: dict[str, Corners] = {}
    rejected, contradicted = [], set()
    for line, row in read_rows(path, ("mapname", *CORNER_COLUMNS)):
        try:
            top, left = parse_position(row["LT_lat_map"], row["LT_lon_map"])
            bottom, right = parse_position(row["RB_lat_map"], row["RB_lon_map"])
            found = Corners(top=top, left=left, bottom=bottom, right=right)
            name = map_name(row["mapname"])
            if corners.setdefault(name, found) != found:
                contradicted.add(name)
                raise Unreadable(f"map {name} has other corners on an earlier line")
        except Unreadable as error:
            rejected.append(unreadable_tag_row(path, line, ",".join(row.values()), error))
    return {name: found for name, found in corners.items() if name not in contradicted}, rejected


def read_maps(
    folder: str, corners: dict[str, Corners]
) -> tuple[list[SatelliteMap], list[Rejection]]:
    """The maps in a flight's folder, ordered by name."""
    maps: list[SatelliteMap] = []
    parts: dict[str, dict[tuple[int, int], tuple[str, int, int]]] = {}
    rejected = []
    for file in storage.list_names(folder):
        if not re.fullmatch(r"satellite.*\.tiff?", file, re.IGNORECASE):
            continue
        path, name = storage.join(folder, file), map_name(file)
        part = MAP_PART_PATTERN.fullmatch(name)
        if name not in corners and not (part and part["map"] in corners):
            found = f"no readable line names {file}"
            rejected.append(Rejection(path=path, reason="map without corners", found=found))
            continue
        try:
            width, height = open_mosaic(path).shape[::-1]
        except OSError as error:
            rejected.append(Rejection(path=path, reason="unreadable map", found=str(error)))
            continue
        if name in corners:
            maps.append(
                SatelliteMap(
                    path=path, name=name, width=width, height=height, corners=corners[name]
                )
            )
        elif part:
            cell = int(part["row"]), int(part["column"])
            parts.setdefault(part["map"], {})[cell] = (path, width, height)
    for name, cells in parts.items():
        try:
            maps += _place_parts(name, cells, corners[name])
        except Unreadable as error:
            rejected += [
                Rejection(path=path, reason="incomplete map", found=str(error))
                for path, _, _ in cells.values()
            ]
    return sorted(maps, key=lambda found: found.name), rejected


def _place_parts(
    name: str, cells: dict[tuple[int, int], tuple[str, int, int]], corners: Corners
) -> Iterator[SatelliteMap]:
    """Parts by row and column, from 1, each with its share of the map's corners. Raises Unreadable
    where they do not fill the map.
    """
    rows, columns = max(row for row, _ in cells), max(column for _, column in cells)
    # Counted first: a file's name may claim any number of parts.
    if len(cells) != rows * columns or not all(row and column for row, column in cells):
        raise Unreadable(
            f"{len(cells)} parts in {rows} rows and {columns} columns, expected one for each"
        )
    heights = [cells[row, 1][2] for row in range(1, rows + 1)]
    widths = [cells[1, column][1] for column in range(1, columns + 1)]
    if any(
        cells[row, column][1:] != (widths[column - 1], heights[row - 1]) for row, column in cells
    ):
        raise Unreadable("parts of one row differ in height, or parts of one column in width")
    tall, wide = sum(heights), sum(widths)
    for row, column in sorted(cells):
        path, width, height = cells[row, column]
        y, x = sum(heights[: row - 1]), sum(widths[: column - 1])
        yield SatelliteMap(
            path=path,
            name=f"{name}_{row:02d}-{column:02d}",
            width=width,
            height=height,
            corners=corners.inside(y / tall, x / wide, (y + height) / tall, (x + width) / wide),
        )
