"""Windows of the map around candidates, put together from the gallery's tiles.

In: a gallery's positions, and readers of its tiles' pixels and footprints. Out: windows with their
features. Windows lie on a grid of half their own size, so that neighbouring photos share them.
"""

import math
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property, partial
from typing import Literal, Protocol

import numpy as np

from pipeline.camera.framing import tile_levels
from pipeline.camera.local_plane import LocalPlane, tile_side_m
from pipeline.camera.map_window import MapWindow, Tile, compose_window
from pipeline.core.arrays import Doubles, Ints, Pixels, Strings, evenly_spaced
from pipeline.core.geo import Circle
from pipeline.images.decode import DecodeError, decode
from pipeline.images.inspect import inspect
from pipeline.images.thumbnails import ImageLoader
from pipeline.matching.local_features import DenseFinder
from pipeline.matching.photo_features import MatchablePhoto
from pipeline.matching.refine import MatchableWindow, prepare_dense_window, prepare_window
from pipeline.matching.relief import Relief


class TilePositions(Protocol):
    """The tiles of a gallery and where their middles lie."""

    @property
    def keys(self) -> Strings:
        """Keys of the tiles (N,)."""

    @property
    def positions_N2(self) -> Doubles:
        """Latitudes and longitudes (N, 2), NaN where unknown."""

    @property
    def rows(self) -> int:
        """Of the whole gallery, of which these may be a sample."""

    @property
    def level_sides_m(self) -> list[float]:
        """The sides of the tiles of its levels, metres, rising; empty where they are not known."""

    def nearest(self, lat: float, lon: float, count: int, side_m: float | None = None) -> Ints:
        """Numbers of the tiles nearest to a position, nearest first; of the level of this side."""


class FeatureSearch(Protocol):
    """The features of a whole map: `map_features.MapSearch`."""

    def window(self, lat: float, lon: float, half_m: float) -> MatchableWindow | None:
        """Those within `half_m` metres of a position, if they are at hand and there are any."""

    def places(
        self, photo: MatchablePhoto, most: int, away_from: Circle | None = None
    ) -> list[tuple[float, float]]:
        """The likeliest places (lat, lon), at most `most`, none within `away_from`."""


HeightReader = Callable[[LocalPlane, float], Relief | None]
"Heights within so many metres of a plane's zero; None where there are none."
Footprints = Callable[[Iterable[str]], Mapping[str, list[list[float]]]]
"Corners (lat, lon) of gallery images by key, where known."
TILES_ACROSS = 4.0
"Side of a window in sides of a tile: photos see one to four."
MOST_SIDE_PX = 1200
"Of a window: more pixels than a photo of 640 can use."
DENSE_WINDOW_PX = 640
"Likewise, where its features are dense: a network sees all of them."
WINDOWS_IN_MEMORY = 48
"Some 8 MB each."
GRID_STEPS = 4
"Of the grid that windows lie on, from one side of a window to the other."
MOST_TILES = 400
"Of a window."
SIDES_SAMPLE = 200
"Tiles whose sizes are looked at."
Place = tuple[float, int, int]
"Half a window's side in metres, and the row and column of its grid."
Kind = Literal["sift", "dense"]
"Of a window's features."


class MapWindows:
    """The windows of one gallery, made when asked for; the latest are kept."""

    def __init__(self, gallery: TilePositions, fetch: ImageLoader, footprints: Footprints) -> None:
        self._gallery, self._fetch, self._footprints = gallery, fetch, footprints
        self.search: FeatureSearch | None = None
        "By the features of the whole map, if they are to be searched."
        self.dense: DenseFinder | None = None
        "Of dense features, if photos that SIFT does not place are matched by them."
        self.heights: HeightReader | None = None
        "Of the map's ground, where there is a surface model."
        self._kept: OrderedDict[tuple[Kind, Place], MatchableWindow | None] = OrderedDict()

    def around(
        self,
        positions: Iterable[tuple[float, float, str]],
        most: int,
        reach_m: float = 0.0,
        kind: Kind = "sift",
    ) -> Iterator[MatchableWindow]:
        """The windows around positions (lat, lon, key of the tile there), each once, at most `most`
        of them; `reach_m`: the least half of a window's side. Dense ones need `dense`."""
        seen: set[Place] = set()
        for lat, lon, key in positions:
            half_m = self._half_side(key, reach_m)
            if half_m is None:
                continue
            place = self._place(lat, lon, half_m)
            if place in seen:
                continue
            if len(seen) == most:
                return
            seen.add(place)
            window = self._window(kind, place)
            if window is not None:
                yield window

    def tile_sides_m(self) -> list[float]:
        """The sides of the gallery's levels, metres, rising."""
        return self._sides_m

    @cached_property
    def _sides_m(self) -> list[float]:
        if self._gallery.level_sides_m:
            return self._gallery.level_sides_m
        numbers = evenly_spaced(len(self._gallery.keys), SIDES_SAMPLE)
        shown = self._footprints([str(key) for key in self._gallery.keys[numbers]])
        return tile_levels(np.array([tile_side_m(footprint) for footprint in shown.values()]))

    def apart_m(self, tile_m: float | None) -> float:
        """How far apart two places are at least, if no window around a tile at the one shows the
        ground that a photo of the other does: a window's half side, its grid's step, and half a
        photo of some tiles. `tile_m`: the tile's side; None where it is not known."""
        side_m = max(self.tile_sides_m(), default=0.0) if tile_m is None else tile_m
        return 2 * _on_the_grid(TILES_ACROSS / 2 * side_m)

    def _half_side(self, key: str, reach_m: float) -> float | None:
        """Half the side of the window for a tile, metres, in steps of a quarter more; None where
        the tile's ground is not known."""
        footprint = self._footprints([key]).get(key)
        if footprint is None:
            return None
        return _on_the_grid(max(TILES_ACROSS / 2 * tile_side_m(footprint), reach_m))

    def _place(self, lat: float, lon: float, half_m: float) -> Place:
        row = round(lat / self._step_lat(half_m))
        return half_m, row, round(lon / self._step_lon(half_m, row))

    def _step_lat(self, half_m: float) -> float:
        return 2 * half_m / GRID_STEPS / 111_000

    def _step_lon(self, half_m: float, row: int) -> float:
        lat = row * self._step_lat(half_m)
        return self._step_lat(half_m) / max(math.cos(math.radians(lat)), 0.01)

    def _window(self, kind: Kind, place: Place) -> MatchableWindow | None:
        asked = kind, place
        if asked in self._kept:
            self._kept.move_to_end(asked)
        else:
            self._kept[asked] = self._make(kind, place)
            if len(self._kept) > WINDOWS_IN_MEMORY:
                self._kept.popitem(last=False)
        return self._kept[asked]

    def _make(self, kind: Kind, place: Place) -> MatchableWindow | None:
        half_m, row, column = place
        lat, lon = row * self._step_lat(half_m), column * self._step_lon(half_m, row)
        window = (
            self._features_at(lat, lon, half_m)
            if kind == "sift"
            else self._dense_features_at(lat, lon, half_m)
        )
        if window is None or self.heights is None:
            return window
        return replace(window, relief=self.heights(LocalPlane(lat=lat, lon=lon), half_m))

    def _features_at(self, lat: float, lon: float, half_m: float) -> MatchableWindow | None:
        if self.search and self._level_for(half_m) == min(self._sides_m, default=None):
            known = self.search.window(lat, lon, half_m)
            if known is not None:
                return known
        window = self.compose(lat, lon, half_m)
        return None if window is None else prepare_window(window)

    def _dense_features_at(self, lat: float, lon: float, half_m: float) -> MatchableWindow | None:
        window = self.compose(lat, lon, half_m, DENSE_WINDOW_PX)
        if window is None or self.dense is None:
            return None
        return prepare_dense_window(window, self.dense)

    def cover(self, most: int) -> tuple[list[tuple[float, float]], float]:
        """The middles (lat, lon) of windows of the finest level that together show the map, side by
        side, and half their side in metres; no middles where more than `most` are needed, or the
        gallery is a sample of a larger one."""
        half_m = _on_the_grid(TILES_ACROSS / 2 * min(self.tile_sides_m(), default=0.0))
        if not self.tile_sides_m() or self._gallery.rows > len(self._gallery.keys):
            return [], half_m
        known_N = ~np.isnan(self._gallery.positions_N2).any(axis=1)
        step_lat = GRID_STEPS * self._step_lat(half_m)
        middles: set[tuple[float, float]] = set()
        for lat, lon in self._gallery.positions_N2[known_N].tolist():
            row = round(lat / step_lat)
            step_lon = GRID_STEPS * self._step_lon(half_m, GRID_STEPS * row)
            middles.add((row * step_lat, round(lon / step_lon) * step_lon))
            if len(middles) > most:
                return [], half_m
        return sorted(middles), half_m

    def compose(
        self, lat: float, lon: float, half_m: float, most_px: int | None = None
    ) -> MapWindow | None:
        """The map within `half_m` metres of a position, of the tiles of one level: the one of which
        TILES_ACROSS come nearest to filling it; at most `most_px` pixels wide (MOST_SIDE_PX). None
        where no tile shows it."""
        plane = LocalPlane(lat=lat, lon=lon)
        side_m = self._level_for(half_m)
        keys = self._keys_within(plane, half_m, side_m)
        footprints = self._footprints(keys)
        images = self._fetch(footprints)
        tiles = [
            Tile(
                read=partial(decode_or_none, images[key]),
                footprint=footprints[key],
                metres_per_pixel=tile_side_m(footprints[key]) / math.sqrt(pixels),
            )
            for key in keys
            if key in footprints and key in images and (pixels := _pixels(images[key]))
        ]
        if not tiles:
            return None
        finest_m = min(tile.metres_per_pixel for tile in tiles)
        least_m = 2 * half_m / (most_px or MOST_SIDE_PX)
        return compose_window(plane, tiles, half_m, max(finest_m, least_m))

    def _level_for(self, half_m: float) -> float | None:
        """The side of the tiles that a window is put together from; None where none is known."""
        wanted_m = 2 * half_m / TILES_ACROSS
        return min(self._sides_m, key=lambda side: abs(math.log(side / wanted_m)), default=None)

    def _keys_within(self, plane: LocalPlane, half_m: float, side_m: float | None) -> list[str]:
        """Tiles of a level that a window may show, nearest first."""
        reach_m = half_m + (side_m or 0.0)
        numbers = self._gallery.nearest(plane.lat, plane.lon, MOST_TILES, side_m)
        away_N = np.abs(plane.to_metres(self._gallery.positions_N2[numbers])).max(axis=1)
        return [str(key) for key in self._gallery.keys[numbers[away_N < reach_m]]]


def _on_the_grid(half_m: float) -> float:
    """Half a window's side, metres, in steps of a quarter more."""
    return float(1.25 ** math.ceil(math.log(max(half_m, 1.0), 1.25) - 1e-6))


def _pixels(data: bytes) -> int:
    """The number of a tile's pixels, by its head; 0 of a damaged one."""
    try:
        width, height = inspect(data)
    except DecodeError:
        return 0
    return width * height


def decode_or_none(data: bytes) -> Pixels | None:
    """The pixels; None of a damaged tile, which leaves a hole in the window."""
    try:
        return decode(data)
    except DecodeError:
        return None
