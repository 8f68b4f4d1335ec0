"""Tiles of web maps -> ImageRecords.

In: folders `<zoom>/<x>/<y>.png` (jpg, webp), or an MBTiles file. Out: a record per tile of one
zoom, or of several as levels, with the tile's position; its bytes are packed as they are. Which end
rows count from is compared with the bounds that a file or the files beside a folder state.
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache

from pipeline.core import storage
from pipeline.core.errors import InputError, require
from pipeline.core.progress import console
from pipeline.core.records import ImageRecord, Rejection, Scanned, SkippedFile, Split, View
from pipeline.images.inspect import is_image_name
from pipeline.sources.base import Source, not_an_image
from pipeline.sources.maps import mbtiles
from pipeline.sources.maps.mosaic import file_version
from pipeline.sources.maps.tile_metadata import (
    Bounds,
    Rows,
    choose_rows,
    parse_metadata,
    read_folder_metadata,
    tile_range,
)
from pipeline.sources.maps.web_mercator import MAX_ZOOM, flip_row, is_on_grid, tile_geotag

TILE_PATH = re.compile(
    r"(\d{1,2})/(\d{1,10})/(\d{1,10})(?:@(\d)x)?\.(png|jpe?g|webp)", re.IGNORECASE | re.ASCII
)
_LAYOUT = "<zoom>/<x>/<y>.png, .jpg or .webp"


@dataclass(frozen=True, kw_only=True)
class Xyz(Source):
    """Tiles of web maps: z/x/y folders or an MBTiles file."""

    zoom: int | tuple[int, ...] | None = None
    """Zoom whose tiles are packed; None: the deepest that is there. Several, such as 17 18 19, are
    levels for photos from different heights."""
    tms: bool = False
    "Whether rows count from the south, as TMS does: --rows south."
    rows: Rows = "auto"
    """The end that rows count from. auto: by the bounds that the set states, else by the order that
    it states, else from the north in folders and from the south in MBTiles files."""
    view: View = View.SATELLITE
    "From where the map is seen."
    split: Split = Split.GALLERY
    "The part of the data set that the tiles become."

    def __post_init__(self) -> None:
        valid = all(0 <= zoom <= MAX_ZOOM for zoom in self._zooms) and self.zoom != ()
        require(valid, "zoom", self.zoom, f"a number from 0 to {MAX_ZOOM}")
        once = len(set(self._zooms)) == len(self._zooms)
        require(once, "zoom", self.zoom, "each zoom once")
        valid = not (self.tms and self.rows == "north")
        require(valid, "rows", self.rows, "south or auto beside --tms; leave one out")

    def scan(self, root: str) -> Iterator[Scanned]:
        if root.lower().endswith(".mbtiles") and storage.is_file(root):
            return self._scan_file(root)
        if storage.is_folder(root):
            return self._scan_folder(root)
        raise InputError(
            f"no folder and no .mbtiles file at {root}; expected {_LAYOUT} or MBTiles; check --root"
        )

    def read(self, record: ImageRecord) -> bytes:
        """The tile's own bytes. Raises OSError."""
        if not record.part:
            return super().read(record)
        return mbtiles.read_tile(record.path, *self._stored(record))

    def ending(self, record: ImageRecord) -> str:
        if not record.part:
            return super().ending(record)
        return mbtiles.read_tile_format(record.path, *self._stored(record))

    def _stored(self, record: ImageRecord) -> tuple[int, int, int]:
        """Zoom, column and row of a record's tile as its file counts. Raises OSError."""
        zoom, x, y = map(int, record.part.split("-"))
        try:
            rows = _rows_of_file(record.path, file_version(record.path), zoom, self._asked)
        except InputError as error:  # the file was readable when it was scanned
            raise OSError(str(error)) from None
        return zoom, x, y if rows == "north" else flip_row(zoom, y)

    @property
    def _asked(self) -> Rows:
        return "south" if self.tms else self.rows

    def _scan_file(self, root: str) -> Iterator[Scanned]:
        mbtiles.read_metadata(root)
        counts = mbtiles.count_zooms(root)
        zooms = {zoom: count for zoom, count in counts.items() if _is_zoom(zoom)}
        chosen = self._choose_zooms(root, zooms)
        for stored_zoom, count in counts.items():
            if stored_zoom not in zooms:
                found = f"{count} tiles of zoom {stored_zoom!r}, expected 0 to {MAX_ZOOM}"
                yield Rejection(path=root, reason="outside of the map", found=found)
        yield from _other_zooms(root, zooms, chosen)
        for zoom in chosen:
            yield from self._scan_file_zoom(root, zoom)

    def _scan_file_zoom(self, root: str, zoom: int) -> Iterator[Scanned]:
        rows = _rows_of_file(root, file_version(root), zoom, self._asked)
        for tile in mbtiles.list_tiles(root, zoom):
            if isinstance(tile, Rejection):
                yield tile
                continue
            y = tile.row if rows == "north" else flip_row(zoom, tile.row)
            part = f"{zoom}-{tile.x}-{y}"
            if not is_on_grid(zoom, tile.x, y):
                yield _off_grid(f"{root}#{part}", zoom, tile.x, y)
            elif not tile.kind:
                found = f"a tile that begins with {tile.start!r}"
                yield Rejection(path=f"{root}#{part}", reason="not an image", found=found)
            else:
                yield self._record(root, part, zoom, tile.x, y, None)

    def _scan_folder(self, root: str) -> Iterator[Scanned]:
        files = storage.walk(root)
        tiles: dict[str, tuple[int, int, int, int]] = {}
        "Zoom, column, row and scale (2 of an @2x name) by path."
        for path in files:
            match = TILE_PATH.fullmatch(path)
            if match and int(match[1]) <= MAX_ZOOM:
                tiles[path] = int(match[1]), int(match[2]), int(match[3]), int(match[4] or 1)
        if not tiles and any(path.lower().endswith(mbtiles.VECTOR_FORMATS) for path in files):
            raise InputError(f"{root} holds vector tiles, which show no pixels; expected {_LAYOUT}")
        zooms = Counter(zoom for zoom, *_ in tiles.values())
        chosen = self._choose_zooms(root, zooms)
        wanted = {path: tile for path, tile in tiles.items() if tile[0] in chosen}
        rows_of = {
            zoom: self._rows_of_folder(
                root, files, zoom, [tile[1:3] for tile in wanted.values() if tile[0] == zoom]
            )
            for zoom in chosen
        }
        largest: dict[tuple[int, int, int], int] = {}
        for zoom, x, row, scale in wanted.values():
            largest[zoom, x, row] = max(scale, largest.get((zoom, x, row), 0))
        yield from _other_zooms(root, zooms, chosen)
        for path, size in files.items():
            full_path = storage.join(root, path)
            if path in wanted:
                zoom, x, row, scale = wanted[path]
                if not is_on_grid(zoom, x, row):
                    yield _off_grid(full_path, zoom, x, row)
                elif scale < largest[zoom, x, row]:
                    yield SkippedFile(path=full_path, reason="tile that is there as @2x")
                else:
                    y = row if rows_of[zoom] == "north" else flip_row(zoom, row)
                    yield self._record(full_path, "", zoom, x, y, size)
            elif path in tiles:
                continue
            elif is_image_name(path):
                found = f"{path} is not {_LAYOUT}"
                yield Rejection(path=full_path, reason="wrong folder", found=found)
            else:
                yield not_an_image(full_path)

    def _rows_of_folder(
        self, root: str, files: Mapping[str, int], zoom: int, tiles: list[tuple[int, int]]
    ) -> Rows:
        """Raises InputError."""

        def count(rows: Rows, bounds: Bounds | None) -> int:
            if bounds is None:
                return len(tiles)
            left, right, top, bottom = tile_range(zoom, bounds, rows)
            return sum(left <= x <= right and top <= row <= bottom for x, row in tiles)

        metadata = read_folder_metadata(root, files)
        return choose_rows(root, self._asked, "north", metadata, zoom, count)

    def _choose_zooms(self, root: str, zooms: Mapping[int, int]) -> tuple[int, ...]:
        """The zooms to pack. Raises InputError where there is no tile of one."""
        if not zooms:
            raise InputError(f"no tiles in {root}; expected {_LAYOUT} or MBTiles; check --root")
        found = sorted(zooms)
        if self.zoom is None:
            *others, zoom = found
            if others:
                listed = ", ".join(map(str, others))
                console.print(
                    f"{root}: taking zoom {zoom}, the deepest; --zoom takes another of {listed}",
                    markup=False,
                )
            return (zoom,)
        for zoom in self._zooms:
            if zoom not in zooms:
                raise InputError(
                    f"no tiles of zoom {zoom} in {root}; it holds zooms "
                    f"{', '.join(map(str, found))}; choose one"
                )
        return self._zooms

    @property
    def _zooms(self) -> tuple[int, ...]:
        """The zooms that were asked for."""
        if isinstance(self.zoom, tuple):
            return self.zoom
        return () if self.zoom is None else (self.zoom,)

    def _record(
        self, path: str, part: str, zoom: int, x: int, y: int, size: int | None
    ) -> ImageRecord:
        """`y` counts from the north, so that a tile has one name whatever its file counts from."""
        return ImageRecord(
            path=path,
            part=part,
            split=self.split,
            view=self.view,
            location=f"{zoom}-{x}-{y}",
            level=f"z{zoom}" if len(self._zooms) > 1 else "",
            geotag=tile_geotag(zoom, x, y),
            bytes=size,
        )


@lru_cache(maxsize=64)
def _rows_of_file(path: str, version: tuple[int, ...], zoom: int, asked: Rows) -> Rows:
    """The row order of an MBTiles file, found once per process and version of the file. Raises
    InputError.
    """

    def count(rows: Rows, bounds: Bounds | None) -> int:
        area = None if bounds is None else tile_range(zoom, bounds, rows)
        return mbtiles.count_tiles_within(path, zoom, area)

    metadata = parse_metadata("its metadata", mbtiles.read_metadata(path))
    return choose_rows(path, asked, "south", [metadata], zoom, count)


def _is_zoom(value: object) -> bool:
    return isinstance(value, int) and 0 <= value <= MAX_ZOOM


def _other_zooms(
    root: str, zooms: Mapping[int, int], chosen: tuple[int, ...]
) -> Iterator[SkippedFile]:
    for zoom, count in sorted(zooms.items()):
        if zoom not in chosen:
            yield SkippedFile(path=root, reason=f"tile of zoom {zoom}", count=count)


def _off_grid(path: str, zoom: int, x: int, y: int) -> Rejection:
    found = f"{x}, {y}; zoom {zoom} has 0 to {2**zoom - 1}"
    return Rejection(path=path, reason="outside of the map", found=found)
