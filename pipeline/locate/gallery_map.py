"""The positions of an index's images: where they lie, how far apart, and how much they show.

In: an opened index. Out: keys and positions of its rows, its levels (images whose ground is of one
size), and the gallery's spacing.
Shapes: N rows, P distinct positions, 2 = latitude and longitude in degrees (NaN where unknown).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from pipeline.camera.framing import level_range, tile_levels
from pipeline.core.arrays import Doubles, Ints, Mask, Strings, evenly_spaced
from pipeline.core.geo import on_sphere
from pipeline.index.searcher import Index

MAX_GALLERY_ROWS = 200_000
"Rows that are read at most: enough to estimate the spacing, and more than a page can draw."


@dataclass(frozen=True, kw_only=True)
class GalleryMap:
    """Rows of an index with their positions."""

    keys: Strings
    locations: Strings
    "Names of their locations (N,)."
    positions_N2: Doubles
    rows: int
    "Rows of the whole index, of which these may be a sample."
    sides_N: Doubles | None = None
    "Sides of the ground that they show, metres, NaN where unknown; None: no row's is known."

    @cached_property
    def level_sides_m(self) -> list[float]:
        """The sides of the gallery's levels, metres, rising; none where they are not known."""
        return [] if self.sides_N is None else tile_levels(self.sides_N)

    @cached_property
    def distinct_positions_P2(self) -> Doubles:
        """The known positions (P, 2) without repetition; of the finest level, where there are
        several: others lie on the same ground."""
        known_N = ~np.isnan(self.positions_N2).any(axis=1)
        return np.unique(self.positions_N2[known_N & self._of_level(self.finest_side_m)], axis=0)

    @property
    def finest_side_m(self) -> float | None:
        """Side of the finest level; None where none is known."""
        return next(iter(self.level_sides_m), None)

    @property
    def position_count(self) -> float:
        """Estimated number of distinct positions in the whole index."""
        return len(self.distinct_positions_P2) * self.rows / max(len(self.keys), 1)

    @cached_property
    def spacing_m(self) -> float | None:
        """Median distance in metres from a position to the next one of its level, the finest; None
        where no two are known.

        For a sample of n of N rows it is the sample's median times sqrt(n / N), as on an area.
        """
        if len(self.distinct_positions_P2) < 2:
            return None
        points_P3 = on_sphere(self.distinct_positions_P2)
        distance_P2, _ = cKDTree(points_P3).query(points_P3, k=2)
        return float(np.median(distance_P2[:, 1]) * np.sqrt(len(self.keys) / self.rows))

    def _of_level(self, side_m: float | None) -> Mask:
        """Which rows (N,) are of the level of this side; all, for None."""
        if side_m is None or self.sides_N is None or not self.level_sides_m:
            return np.ones(len(self.keys), np.bool_)
        least_m, most_m = level_range(side_m, self.level_sides_m)
        return np.asarray((least_m <= self.sides_N) & (self.sides_N <= most_m))

    def nearest(self, lat: float, lon: float, count: int, side_m: float | None = None) -> Ints:
        """Numbers of the rows nearest to a position, nearest first, at most `count`; of the level
        of this side, if it is given."""
        known_N = ~np.isnan(self.positions_N2).any(axis=1)
        known = np.flatnonzero(known_N & self._of_level(side_m))
        here_13 = on_sphere(np.array([[lat, lon]]))
        distance_N = np.linalg.norm(on_sphere(self.positions_N2[known]) - here_13, axis=1)
        return np.asarray(known[np.argsort(distance_N, kind="stable")[:count]])


def read_gallery_map(index: Index) -> GalleryMap:
    """The rows of an index, or MAX_GALLERY_ROWS evenly spaced ones; removed locations are left
    out."""
    total = index.metadata.rows
    rows = evenly_spaced(total, MAX_GALLERY_ROWS)
    names = index.ids_of(rows[None])
    location_N = np.asarray(names["location"].to_pylist(), dtype=np.str_)
    kept_N = np.ones(len(rows), np.bool_)
    for part in index.metadata.parts:
        in_part_N = (rows >= part.first_row) & (rows < part.first_row + part.rows)
        kept_N &= ~(in_part_N & np.isin(location_N, np.array(part.removed, dtype=np.str_)))
    lat_N, lon_N, side_N = (
        names[name].to_numpy().astype(np.float64) for name in ("lat", "lon", "side_m")
    )
    return GalleryMap(
        keys=np.asarray(names["key"].to_pylist(), dtype=np.str_)[kept_N],
        locations=location_N[kept_N],
        positions_N2=np.stack([lat_N, lon_N], axis=1)[kept_N],
        sides_N=side_N[kept_N],
        rows=len(index),
    )
