"""The positions of an index's images: where they lie, and how far apart.

In: an opened index. Out: keys and positions of its rows, and the gallery's spacing.
Shapes: N rows, P distinct positions, 2 = latitude and longitude in degrees (NaN where unknown).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from pipeline.core.arrays import Doubles, Ints, Strings
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

    @cached_property
    def distinct_positions_P2(self) -> Doubles:
        """The known positions (P, 2) without repetition."""
        return np.unique(self.positions_N2[~np.isnan(self.positions_N2).any(axis=1)], axis=0)

    @property
    def position_count(self) -> float:
        """Estimated number of distinct positions in the whole index."""
        return len(self.distinct_positions_P2) * self.rows / max(len(self.keys), 1)

    @cached_property
    def spacing_m(self) -> float | None:
        """Median distance in metres from a position to the next one; None where no two are known.

        For a sample of n of N rows it is the sample's median times sqrt(n / N), as on an area.
        """
        if len(self.distinct_positions_P2) < 2:
            return None
        points_P3 = on_sphere(self.distinct_positions_P2)
        distance_P2, _ = cKDTree(points_P3).query(points_P3, k=2)
        return float(np.median(distance_P2[:, 1]) * np.sqrt(len(self.keys) / self.rows))

    def nearest(self, lat: float, lon: float, count: int) -> Ints:
        """Numbers of the rows nearest to a position, nearest first, at most `count`."""
        known = np.flatnonzero(~np.isnan(self.positions_N2).any(axis=1))
        here_13 = on_sphere(np.array([[lat, lon]]))
        distance_N = np.linalg.norm(on_sphere(self.positions_N2[known]) - here_13, axis=1)
        return np.asarray(known[np.argsort(distance_N, kind="stable")[:count]])


def read_gallery_map(index: Index) -> GalleryMap:
    """The rows of an index, or MAX_GALLERY_ROWS evenly spaced ones; removed locations are left
    out."""
    total = index.metadata.rows
    rows = np.unique(np.linspace(0, total - 1, min(total, MAX_GALLERY_ROWS)).astype(np.int64))
    names = index.ids_of(rows[None])
    location_N = np.asarray(names["location"].to_pylist(), dtype=np.str_)
    kept_N = np.ones(len(rows), np.bool_)
    for part in index.metadata.parts:
        in_part_N = (rows >= part.first_row) & (rows < part.first_row + part.rows)
        kept_N &= ~(in_part_N & np.isin(location_N, np.array(part.removed, dtype=np.str_)))
    lat_lon = [names[name].to_numpy().astype(np.float64) for name in ("lat", "lon")]
    return GalleryMap(
        keys=np.asarray(names["key"].to_pylist(), dtype=np.str_)[kept_N],
        locations=location_N[kept_N],
        positions_N2=np.stack(lat_lon, axis=1)[kept_N],
        rows=len(index),
    )
