"""Tiles of web maps -> ImageRecords. In: folders `<zoom>/<x>/<y>.png` (jpg, webp), or an MBTiles
file. Out: a record per tile.

Each record carries where its tile lies, and the tile's own bytes are packed as they are.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.progress import console
from pipeline.core.records import ImageRecord, Rejection, Split, View
from pipeline.images.inspect import is_image_name
from pipeline.sources.base import Source, not_an_image
from pipeline.sources.maps import mbtiles
from pipeline.sources.maps.web_mercator import MAX_ZOOM, flip_row, is_on_grid, tile_geotag

TILE_PATH = re.compile(
    r"(\d{1,2})/(\d{1,10})/(\d{1,10})\.(png|jpe?g|webp)", re.IGNORECASE | re.ASCII
)
LAYOUT = "<zoom>/<x>/<y>.png, .jpg or .webp"


@dataclass(frozen=True, kw_only=True)
class Xyz(Source):
    """Tiles of web maps: z/x/y folders or an MBTiles file."""

    zoom: int | None = None
    "Zoom whose tiles are taken; None: the deepest that is there."
    tms: bool = False
    "Whether a folder's rows count from the south, as TMS does. An MBTiles file says so itself."
    view: View = View.SATELLITE
    "From where the map is seen."
    split: Split = Split.GALLERY
    "The part of the data set that the tiles become."

    def __post_init__(self) -> None:
        if self.zoom is not None and not 0 <= self.zoom <= MAX_ZOOM:
            raise InputError(f"--zoom is {self.zoom}, expected a number from 0 to {MAX_ZOOM}")

    def scan(self, root: str) -> Iterator[ImageRecord | Rejection]:
        if (
            root.lower().endswith(".mbtiles")
            and storage.exists(root)
            and not storage.is_folder(root)
        ):
            return self._scan_file(root)
        if storage.is_folder(root):
            return self._scan_folder(root)
        raise InputError(
            f"no folder and no .mbtiles file at {root}; expected {LAYOUT} or MBTiles; check --root"
        )

    def read(self, record: ImageRecord) -> bytes:
        """The tile's own bytes. Raises OSError."""
        return (
            mbtiles.read_tile(record.path, *_parse_part(record.part))
            if record.part
            else super().read(record)
        )

    def ending(self, record: ImageRecord) -> str:
        return (
            mbtiles.read_tile_format(record.path, *_parse_part(record.part))
            if record.part
            else super().ending(record)
        )

    def _scan_file(self, root: str) -> Iterator[ImageRecord | Rejection]:
        zoom = self._choose(root, mbtiles.list_zooms(root))
        for tile in mbtiles.list_tiles(root, zoom):
            if isinstance(tile, Rejection):
                yield tile
                continue
            part = f"{zoom}-{tile.x}-{tile.y}"
            if not is_on_grid(zoom, tile.x, tile.y):
                yield _off_grid(f"{root}#{part}", zoom, tile.x, tile.y)
            elif not tile.kind:
                found = f"a tile that begins with {tile.start!r}"
                yield Rejection(path=f"{root}#{part}", reason="not an image", found=found)
            else:
                yield self._record(root, part, zoom, tile.x, tile.y, None)

    def _scan_folder(self, root: str) -> Iterator[ImageRecord | Rejection]:
        files = storage.walk(root)
        found = {path: TILE_PATH.fullmatch(path) for path in files}
        there = {int(said[1]) for said in found.values() if said and int(said[1]) <= MAX_ZOOM}
        if not there and any(path.lower().endswith(mbtiles.VECTOR_FORMATS) for path in files):
            raise InputError(f"{root} holds vector tiles, which show no pixels; expected {LAYOUT}")
        zoom = self._choose(root, sorted(there))
        for path, size in files.items():
            said, whole = found[path], storage.join(root, path)
            if not said or int(said[1]) > MAX_ZOOM:
                if is_image_name(path):
                    yield Rejection(
                        path=whole, reason="wrong folder", found=f"{path} is not {LAYOUT}"
                    )
                elif "/" in path:  # beside the zooms lie a viewer's pages and descriptions
                    yield not_an_image(whole)
                continue
            x, y = int(said[2]), int(said[3])
            if int(said[1]) != zoom:
                continue
            if not is_on_grid(zoom, x, y):
                yield _off_grid(whole, zoom, x, y)
            else:
                yield self._record(whole, "", zoom, x, flip_row(zoom, y) if self.tms else y, size)

    def _choose(self, root: str, there: list[int]) -> int:
        """The zoom to take. Raises InputError where there is no tile of it."""
        if not there:
            raise InputError(f"no tiles in {root}; expected {LAYOUT} or MBTiles; check --root")
        zoom = there[-1] if self.zoom is None else self.zoom
        if zoom not in there:
            raise InputError(
                f"no tiles of zoom {zoom} in {root}; it holds zooms {', '.join(map(str, there))}; choose one"
            )
        if self.zoom is None and len(there) > 1:
            others = ", ".join(map(str, there[:-1]))
            console.print(
                f"{root}: taking zoom {zoom}, the deepest; --zoom takes another of {others}",
                markup=False,
            )
        return zoom

    def _record(
        self, path: str, part: str, zoom: int, x: int, y: int, size: int | None
    ) -> ImageRecord:
        """`y` from the north: a place has one name whatever its file counts from."""
        return ImageRecord(
            path=path,
            part=part,
            split=self.split,
            view=self.view,
            location=f"{zoom}-{x}-{y}",
            geotag=tile_geotag(zoom, x, y),
            bytes=size,
        )


def _parse_part(part: str) -> tuple[int, int, int]:
    zoom, x, y = map(int, part.split("-"))
    return zoom, x, y


def _off_grid(path: str, zoom: int, x: int, y: int) -> Rejection:
    return Rejection(
        path=path,
        reason="outside of the map",
        found=f"{x}, {y}; zoom {zoom} has 0 to {2**zoom - 1}",
    )
