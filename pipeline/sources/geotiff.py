"""GeoTIFF mosaics -> tiles as ImageRecords.

In: one file, or a folder of them at any depth. Out: a record per tile. A scan reads headers and
masks; the pixels of a tile are cut out, turned and encoded when it is read.
"""

import math
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Literal

from rasterio.enums import Resampling
from rasterio.errors import RasterioError

from pipeline.core import storage
from pipeline.core.errors import InputError, require
from pipeline.core.progress import console, progress
from pipeline.core.records import ImageRecord, Rejection, Scanned, SkippedFile, Split, View
from pipeline.images.decode import DecodeError
from pipeline.images.inspect import MAX_PIXELS
from pipeline.sources.base import Source
from pipeline.sources.maps.colours import Colours, UnknownColours
from pipeline.sources.maps.georeference import parse_crs
from pipeline.sources.maps.mosaic import (
    MOSAIC_SUFFIXES,
    Encoding,
    colours_for,
    encode_window,
    file_version,
    nodata_share,
    open_mosaic,
    root_cause,
)
from pipeline.sources.maps.placement import MosaicRejected, Placement, place_mosaic
from pipeline.sources.maps.tiles import Tile, count_tiles, parse_window, plan_levels

DEFAULT_TILE_PIXELS = 512
LEAST_RATIO = 1.1
"Between the sides of two levels: nearer ones show the same."
MAX_TILES = 2_000_000
"""Of one mosaic: with their records they take a few gigabytes. A header alone may claim sides of
four thousand million pixels."""


@dataclass(frozen=True, kw_only=True)
class GeoTiff(Source):
    """GeoTIFF mosaics, cut into tiles."""

    tile_m: float | tuple[float, ...] | None = None
    """Side of a tile on the ground, metres, measured at the mosaic's centre; instead of
    --tile-pixels. Several, such as 60 120 240, cut the mosaic once for each: levels for photos
    from different heights."""
    tile_pixels: int | tuple[int, ...] | None = None
    """Side of a tile in the mosaic's pixels, or several; 512 where --tile-m is not given
    either."""
    overlap: float = 0.0
    "Share of a tile that its neighbour shows too, from 0 to below 1, along each side."
    output_pixels: int | None = None
    """Side of a tile as it is written, of every level, pixels; None: as it is cut. Where smaller,
    overviews are read."""
    resampling: Literal["average", "bilinear", "cubic"] = "average"
    "How pixels become fewer; average does not alias."
    max_nodata: float = 0.5
    "Tiles with a larger share of nodata, transparent or masked pixels are left out."
    stretch: tuple[float, float] | None = None
    """Values that become black and white. None: 8-bit as it is, else the 2nd and 98th percentile of
    the whole mosaic."""
    bands: tuple[int, int, int] | None = None
    """Numbers, from 1, of the bands that are red, green and blue, such as 3 2 1. None: as the file
    names them, else the first three."""
    crs: str | None = None
    "Coordinate system, such as EPSG:32633, of files that name none."
    assume_wgs84: bool = False
    """Take a datum for WGS84 where PROJ knows no shift from it to WGS84, instead of refusing the
    mosaic: positions may be wrong by hundreds of metres."""
    encoding: Encoding = "jpg"
    "Of the tiles: jpg of quality 95 with full colour resolution, or png without loss."
    view: View = View.SATELLITE
    "From where the mosaic is seen."
    split: Split = Split.GALLERY
    "The part of the data set that the tiles become."

    def __post_init__(self) -> None:
        if self.tile_m is not None and self.tile_pixels is not None:
            raise InputError(
                "--tile-m and --tile-pixels are both given; expected one of them: leave one out"
            )
        for flag in ("tile_m", "tile_pixels", "output_pixels"):
            value = getattr(self, flag)
            sides = _several(value)
            valid = all(0 < side < math.inf for side in sides) and value != ()
            require(valid, flag, value, "a number above 0")
            apart = all(more >= LEAST_RATIO * less for less, more in pairwise(sides))
            require(apart, flag, value, f"sizes that rise by {LEAST_RATIO - 1:.0%} or more")
        side, most = self.output_pixels, math.isqrt(MAX_PIXELS)
        require(side is None or side <= most, "output_pixels", side, f"at most {most}")
        require(0 <= self.overlap < 1, "overlap", self.overlap, "a share from 0 to below 1")
        require(0 <= self.max_nodata <= 1, "max_nodata", self.max_nodata, "a share from 0 to 1")
        if self.stretch is not None:
            low, high = self.stretch
            rising = -math.inf < low < high < math.inf
            require(rising, "stretch", self.stretch, "two numbers, the smaller one first")
        if self.bands is not None:
            require(min(self.bands) > 0, "bands", self.bands, "numbers of bands, from 1")
        if self.crs is not None:
            expected = "one such as EPSG:32633; it names no coordinate system"
            require(parse_crs(self.crs) is not None, "crs", self.crs, expected)

    def scan(self, root: str) -> Iterator[Scanned]:
        names: dict[str, str] = {}
        yield from _other_files(root)
        for path, name in find_mosaics(root):
            first = names.setdefault(name, path)
            if first != path:
                found = f"{first} has its name for locations, {name}"
                yield Rejection(path=path, reason="same name twice", found=found)
                continue
            try:
                yield from self._tiles(path, name)
            except MosaicRejected as rejected:
                yield Rejection(path=path, reason=rejected.reason, found=rejected.found)
            except UnknownColours as error:
                yield Rejection(path=path, reason="unknown colours", found=str(error))
            except RasterioError as error:
                yield Rejection(path=path, reason="damaged image", found=root_cause(error))

    def read(self, record: ImageRecord) -> bytes:
        """The tile, encoded; the same bytes each time. Raises DecodeError."""
        window, path = parse_window(record.part), record.path
        size = (window.width, window.height)
        try:
            placement = self._placement(path)
            if self.output_pixels is not None:  # one scale, for a mosaic smaller than a tile too
                tile = self._levels(placement)[record.level]
                scaled = (self.output_pixels * a / b for a, b in zip(size, tile, strict=True))
                width, height = (max(1, round(side)) for side in scaled)
                size = (width, height)
            shown = colours_for(path, self.stretch, self.bands)
        except RasterioError as error:
            raise DecodeError("damaged image", root_cause(error)) from None
        except MosaicRejected as rejected:  # the file was replaced after the scan
            raise DecodeError(rejected.reason, rejected.found) from None
        except UnknownColours as error:
            raise DecodeError("unknown colours", str(error)) from None
        how = Resampling[self.resampling]
        return encode_window(path, window, self.encoding, size, how, shown, placement.flip)

    def ending(self, record: ImageRecord) -> str:
        return self.encoding

    def _tiles(self, path: str, name: str) -> Iterator[ImageRecord]:
        """The tiles of one mosaic. Raises MosaicRejected, UnknownColours, RasterioError."""
        dataset = open_mosaic(path)
        kind = dataset.dtypes[0]
        if kind.startswith("complex"):  # GDAL has some that NumPy has no name for
            found = f"{kind} values; expected integers or floats"
            raise MosaicRejected("not a picture", found)
        placement = self._placement(path)
        planned = self._plan((dataset.width, dataset.height), self._levels(placement))
        shown = colours_for(path, self.stretch, self.bands)
        every = [tile for tiles in planned.values() for tile in tiles]
        kept = self._without_nodata(path, every, shown)
        windows = [tile.window for tile in kept]
        tags = placement.georeference.geotags(windows, placement.flip)
        placed = {tile.window: tag for tile, tag in zip(kept, tags, strict=True) if tag is not None}
        left_out = f", {len(every) - len(kept):,} left out as nodata" if shown.gaps else ""
        if len(placed) < len(kept):
            left_out += f", {len(kept) - len(placed):,} left out as nowhere on Earth"
        (across, down), counted = placement.pixel_m, list[str]()
        for tiles in planned.values():
            count, first = sum(tile.window in placed for tile in tiles), tiles[0].window
            counted.append(f"{count:,} tiles of {first.width} x {first.height} px")
        console.print(
            f"{name}: {dataset.width} x {dataset.height} px of {across:.3g} x {down:.3g} m, "
            f"{placement.description}, {shown.description}, {', '.join(counted)}{left_out}",
            markup=False,
        )
        for level, tiles in planned.items():
            grid = f"{name}-{level}" if level else name
            for tile in tiles:
                if tile.window in placed:
                    yield ImageRecord(
                        path=path,
                        part=tile.window.part,
                        split=self.split,
                        view=self.view,
                        location=f"{grid}-{tile.row}-{tile.column}",
                        level=level,
                        geotag=placed[tile.window],
                    )

    def _placement(self, path: str) -> Placement:
        """Raises MosaicRejected, RasterioError."""
        return _place(path, file_version(path), self.crs, self.assume_wgs84)

    def _plan(
        self, size: tuple[int, int], levels: dict[str, tuple[int, int]]
    ) -> dict[str, list[Tile]]:
        """The tiles by level. Raises MosaicRejected where a tile is larger than an image may be, or
        there are more than MAX_TILES.
        """
        count = 0
        for tile in levels.values():
            asked = f"{size[0]} x {size[1]} pixels in tiles of {tile[0]} x {tile[1]}"
            if min(tile[0], size[0]) * min(tile[1], size[1]) > MAX_PIXELS:
                found = f"{asked}, expected tiles of at most {MAX_PIXELS} pixels: cut smaller ones"
                raise MosaicRejected("absurd dimensions", found)
            if (count := count + count_tiles(size, tile, self.overlap)) > MAX_TILES:
                found = f"{asked} make {count}, expected at most {MAX_TILES}: "
                raise MosaicRejected("too many tiles", f"{found}cut larger ones, or the mosaic")
        return plan_levels(size, levels, self.overlap)

    def _levels(self, placement: Placement) -> dict[str, tuple[int, int]]:
        """(width, height) of a full tile in the mosaic's pixels by the level's name, the smallest
        first; a single level has no name.
        """
        across, down = placement.pixel_m
        sides, unit = _several(self.tile_m), "m"
        if not sides:
            sides, unit = _several(self.tile_pixels) or (DEFAULT_TILE_PIXELS,), "px"
            across = down = 1.0
        sizes = [(max(1, round(side / across)), max(1, round(side / down))) for side in sides]
        if len(sides) == 1:
            return {"": sizes[0]}
        names = (f"{side:g}{unit}".replace(".", "_") for side in sides)
        return dict(zip(names, sizes, strict=True))

    def _without_nodata(self, path: str, tiles: list[Tile], shown: Colours) -> list[Tile]:
        """The tiles that hold enough of an image. Masks are read in threads, and only where the
        mosaic has any.
        """
        if not shown.gaps or self.max_nodata == 1:
            return tiles
        kept = []
        with (
            ThreadPoolExecutor(os.cpu_count()) as pool,
            progress(len(tiles), "looking for nodata", "tiles") as meter,
        ):
            shares = pool.map(lambda tile: nodata_share(path, tile.window, shown), tiles)
            for tile, share in zip(tiles, shares, strict=True):
                meter.advance()
                if share <= self.max_nodata:
                    kept.append(tile)
        return kept


def _several(value: float | tuple[float, ...] | None) -> tuple[float, ...]:
    """The values of a flag that takes one or several."""
    return value if isinstance(value, tuple) else () if value is None else (value,)


@lru_cache(maxsize=256)
def _place(
    path: str, version: tuple[int, ...], crs_name: str | None, assume_wgs84: bool
) -> Placement:
    """`place_mosaic`, once per process and version of the file. Raises what that raises."""
    return place_mosaic(path, crs_name, assume_wgs84)


def _other_files(root: str) -> Iterator[SkippedFile]:
    """Files of a folder that are no GeoTIFF by their names, counted by their endings."""
    if not storage.is_folder(root):
        return
    for name in storage.walk(root):
        if not name.lower().endswith(MOSAIC_SUFFIXES):
            ending = name.rsplit("/", 1)[-1].rpartition(".")[2].lower()[:8]
            path = storage.join(root, name)
            yield SkippedFile(path=path, reason=f"file that is no GeoTIFF (.{ending})")


def find_mosaics(root: str) -> Iterator[tuple[str, str]]:
    """(path, name) of the GeoTIFF at `root` or of all below it; a name is the path from there
    without its ending, joined by hyphens.

    Raises InputError where there is none.
    """
    if storage.is_folder(root):
        found = [name for name in storage.walk(root) if name.lower().endswith(MOSAIC_SUFFIXES)]
        if not found:
            raise InputError(
                f"no .tif or .tiff below {root}; expected GeoTIFF mosaics; check --root"
            )
        for name in found:
            yield storage.join(root, name), name.rsplit(".", 1)[0].replace("/", "-")
    elif storage.exists(root):
        yield root, root.rsplit("/", 1)[-1].rsplit(".", 1)[0]
    else:
        raise InputError(
            f"nothing at {root}; expected a GeoTIFF mosaic, or a folder of them; check --root"
        )
