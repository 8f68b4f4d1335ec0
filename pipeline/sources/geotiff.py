"""GeoTIFF mosaics -> tiles as ImageRecords. In: one file, or a folder of them at any depth. Out: a
record per tile.

Tiles are told from coordinates and masks alone; their pixels are cut out, and encoded, when they
are read.
"""

import math
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from rasterio.enums import Resampling
from rasterio.errors import RasterioError

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.progress import console, progress
from pipeline.core.records import ImageRecord, Rejection, Split, View
from pipeline.images.decode import DecodeError
from pipeline.images.inspect import MAX_PIXELS
from pipeline.sources.base import Source
from pipeline.sources.maps.colours import Colours
from pipeline.sources.maps.georeference import Georeference, parse_crs
from pipeline.sources.maps.mosaic import (
    Encoding,
    colours_for,
    encode_window,
    nodata_share,
    open_mosaic,
    root_cause,
)
from pipeline.sources.maps.tiles import Tile, count_tiles, parse_window, plan_tiles

DEFAULT_TILE_PIXELS = 512  # where no size is asked for
MIN_PIXEL_M = 1e-6  # below it pixels are no places: all lie on one point, or on one line
MAX_TILES = 2_000_000
"""Of one mosaic: with their records they take a few gigabytes. A header alone may say sides of four
thousand million pixels."""


@dataclass(frozen=True, kw_only=True)
class GeoTiff(Source):
    """GeoTIFF mosaics, cut into tiles."""

    tile_m: float | None = None
    """Side of a tile on the ground, metres, measured at the mosaic's centre; instead of
    --tile-pixels."""
    tile_pixels: int | None = None
    "Side of a tile in the mosaic's pixels; 512 where --tile-m is not given either."
    overlap: float = 0.0
    "Share of a tile that its neighbour shows too, from 0 to below 1, along each side."
    output_pixels: int | None = None
    """Side of a tile as it is written, pixels; None: as it is cut. Where smaller, overviews are
    read."""
    resampling: Literal["average", "bilinear", "cubic"] = "average"
    "How pixels become fewer; average does not alias."
    max_nodata: float = 0.5
    "Tiles with a larger share of nodata, transparent or masked pixels are left out."
    stretch: tuple[float, float] | None = None
    """Values that become black and white. None: 8-bit as it is, else the 2nd and 98th percentile of
    the whole mosaic."""
    crs: str | None = None
    "Coordinate system, such as EPSG:32633, of files that name none."
    encoding: Encoding = "jpg"
    "Of the tiles: jpg of quality 95 with full colour resolution, or png without loss."
    view: View = View.SATELLITE
    "From where the mosaic is seen."
    split: Split = Split.GALLERY
    "The part of the data set that the tiles become."

    def __post_init__(self) -> None:
        if self.tile_m is not None and self.tile_pixels is not None:
            raise InputError(
                "--tile-m and --tile-pixels are both given; expected one of them: leave the other out"
            )
        sides = {
            "tile-m": self.tile_m,
            "tile-pixels": self.tile_pixels,
            "output-pixels": self.output_pixels,
        }
        for flag, value in sides.items():
            if value is not None and not 0 < value < math.inf:
                raise InputError(f"--{flag} is {value}, expected a number above 0")
        if self.output_pixels is not None and self.output_pixels**2 > MAX_PIXELS:
            raise InputError(
                f"--output-pixels is {self.output_pixels}, expected at most {math.isqrt(MAX_PIXELS)}"
            )
        if not 0 <= self.overlap < 1:
            raise InputError(f"--overlap is {self.overlap}, expected a share from 0 to below 1")
        if not 0 <= self.max_nodata <= 1:
            raise InputError(f"--max-nodata is {self.max_nodata}, expected a share from 0 to 1")
        if (
            self.stretch is not None
            and not -math.inf < self.stretch[0] < self.stretch[1] < math.inf
        ):
            raise InputError(
                f"--stretch is {self.stretch[0]} {self.stretch[1]}, expected two numbers, the smaller one first"
            )
        if self.crs is not None and parse_crs(self.crs) is None:
            raise InputError(
                f"--crs is {self.crs!r}, which names no coordinate system; expected one such as EPSG:32633"
            )

    def scan(self, root: str) -> Iterator[ImageRecord | Rejection]:
        names: dict[str, str] = {}
        for path, name in find_mosaics(root):
            first = names.setdefault(name, path)
            if first != path:
                yield Rejection(
                    path=path,
                    reason="same name twice",
                    found=f"{first} has its name for locations, {name}",
                )
                continue
            try:
                yield from self._tiles(path, name)
            except _MosaicRejected as refused:
                yield Rejection(path=path, reason=refused.reason, found=refused.found)
            except RasterioError as error:
                yield Rejection(path=path, reason="damaged image", found=root_cause(error))

    def read(self, record: ImageRecord) -> bytes:
        """The tile, encoded; the same bytes each time. Raises DecodeError."""
        window = parse_window(record.part)
        size = (window.width, window.height)
        if (
            self.output_pixels is not None
        ):  # the same scale for the smaller tile of a smaller mosaic
            size = self._output_size(record.path, size, self.output_pixels)
        return encode_window(
            record.path, window, self.encoding, size, Resampling[self.resampling], self.stretch
        )

    def ending(self, record: ImageRecord) -> str:
        return self.encoding

    def _tiles(self, path: str, name: str) -> Iterator[ImageRecord]:
        """The tiles of one mosaic. Raises _Refused, RasterioError."""
        dataset = open_mosaic(path)
        if dataset.dtypes[0].startswith("complex"):  # GDAL has some that NumPy has no name for
            raise _MosaicRejected(
                "not a picture", f"{dataset.dtypes[0]} values; expected integers or floats"
            )
        place = self._georeference(dataset)
        planned = self._plan((dataset.width, dataset.height), self._tile_size(dataset, place))
        shown = colours_for(path, self.stretch)
        kept = self._without_nodata(path, planned, shown)
        tags = place.geotags(tile.window for tile in kept)
        placed = [(tile, tag) for tile, tag in zip(kept, tags, strict=True) if tag is not None]
        across, down = place.ground_pixel((dataset.width / 2, dataset.height / 2))
        left_out = f", {len(planned) - len(kept):,} left out as nodata" if shown.gaps else ""
        left_out += (
            f", {len(kept) - len(placed):,} left out as nowhere on Earth"
            if len(placed) < len(kept)
            else ""
        )
        first = planned[0].window
        console.print(
            f"{name}: {dataset.width} x {dataset.height} px of {across:.3g} x {down:.3g} m, {place.name}, {shown.said}, "
            f"{len(placed):,} tiles of {first.width} x {first.height} px{left_out}",
        )
        for tile, tag in placed:
            yield ImageRecord(
                path=path,
                part=tile.window.part,
                split=self.split,
                view=self.view,
                location=f"{name}-{tile.row}-{tile.column}",
                geotag=tag,
            )

    def _plan(self, size: tuple[int, int], tile: tuple[int, int]) -> list[Tile]:
        """Raises _Refused where a tile is larger than an image may be, or there are more than
        anybody could want.
        """
        said = f"{size[0]} x {size[1]} pixels in tiles of {tile[0]} x {tile[1]}"
        if min(tile[0], size[0]) * min(tile[1], size[1]) > MAX_PIXELS:
            raise _MosaicRejected(
                "absurd dimensions",
                f"{said}, expected tiles of at most {MAX_PIXELS} pixels: cut smaller ones",
            )
        if (count := count_tiles(size, tile, self.overlap)) > MAX_TILES:
            raise _MosaicRejected(
                "too many tiles",
                f"{said} make {count}, expected at most {MAX_TILES}: cut larger ones, or the mosaic",
            )
        return plan_tiles(size, tile, self.overlap)

    def _georeference(self, dataset: Any) -> Georeference:
        """Where the mosaic lies. Raises _Refused where it does not say."""
        with_gcps = f"{len(dataset.gcps[0])} ground control points alone" if dataset.gcps[0] else ""
        if dataset.transform.is_identity:
            found = f"{with_gcps or 'no transform'}; expected pixels with coordinates: warp it with gdalwarp"
            raise _MosaicRejected("no coordinates", found)
        crs = dataset.crs or (self.crs and parse_crs(self.crs))
        if not crs:
            raise _MosaicRejected(
                "no coordinates", "no coordinate system; expected one: name it with --crs EPSG:..."
            )
        place = Georeference(crs=crs, affine=dataset.transform)
        ground = place.ground_pixel((dataset.width / 2, dataset.height / 2))
        if not np.isfinite(ground).all():
            raise _MosaicRejected(
                "no coordinates", f"its centre lies nowhere on Earth by {place.name}"
            )
        if not min(ground) > MIN_PIXEL_M:
            raise _MosaicRejected(
                "no coordinates",
                f"pixels of {ground[0]:g} x {ground[1]:g} m by {place.name}, expected larger ones",
            )
        return place

    def _tile_size(self, dataset: Any, place: Georeference) -> tuple[int, int]:
        """(width, height) of a whole tile in the mosaic's pixels."""
        if self.tile_m is None:
            return (self.tile_pixels or DEFAULT_TILE_PIXELS,) * 2
        across, down = place.ground_pixel((dataset.width / 2, dataset.height / 2))
        return max(1, round(self.tile_m / across)), max(1, round(self.tile_m / down))

    def _output_size(self, path: str, size: tuple[int, int], side_out: int) -> tuple[int, int]:
        """(width, height) in which a window of `size` is written, a whole tile with `side_out`.
        Raises DecodeError.
        """
        try:
            dataset = open_mosaic(path)
            whole = self._tile_size(dataset, self._georeference(dataset))
        except RasterioError as error:
            raise DecodeError("damaged image", root_cause(error)) from None
        except _MosaicRejected as refused:  # another file than the one that was scanned
            raise DecodeError(refused.reason, refused.found) from None
        width, height = (side_out * part / side for part, side in zip(size, whole, strict=True))
        return max(1, round(width)), max(1, round(height))

    def _without_nodata(self, path: str, tiles: list[Tile], shown: Colours) -> list[Tile]:
        """The tiles that hold enough of an image. Masks are read only where the mosaic has any, in
        threads.
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


class _MosaicRejected(Exception):
    """A mosaic that cannot be cut; `reason` and `found` as in a Rejection."""

    def __init__(self, reason: str, found: str) -> None:
        super().__init__(f"{reason}: {found}")
        self.reason, self.found = reason, found


def find_mosaics(root: str) -> Iterator[tuple[str, str]]:
    """(path, name) of the GeoTIFF at `root` or of all below it; a name is the path from there
    without its ending, joined by hyphens.

    Raises InputError where there is none.
    """
    if storage.is_folder(root):
        found = [name for name in storage.walk(root) if name.lower().endswith((".tif", ".tiff"))]
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
