"""The images of an index on the map: where they lie, and how far apart.

In: the index's `ids.parquet`. Out: keys, locations and positions of its rows, and the gallery's spacing.
Shapes: N rows, 2 = latitude and longitude in degrees (NaN where unknown).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pyarrow.parquet as pq
from scipy.spatial import cKDTree

from pipeline import storage
from pipeline.consensus import on_sphere
from pipeline.features import Words
from pipeline.index import IDS
from pipeline.metrics import Doubles, Whole

MOST = 200_000
"Rows that are read at most: enough for the spacing, and more than a page can draw."


@dataclass(frozen=True, kw_only=True)
class GalleryMap:
    """Rows of an index."""

    keys: Words
    locations: Words
    places_N2: Doubles
    rows: int
    "Of the whole index; these are its first ones, a fair sample, as shards are in the order of hashes."

    @cached_property
    def spacing_m(self) -> float | None:
        """Median distance from a position to the next other one, metres; None where no two are known.

        From a sample of n of N rows it is taken for sqrt(n / N) of what the sample shows, as on an area.
        """
        known_N2 = self.places_N2[~np.isnan(self.places_N2).any(axis=1)]
        distinct_N2 = np.unique(known_N2, axis=0)
        if len(distinct_N2) < 2:
            return None
        points_N3 = on_sphere(distinct_N2)
        apart_N2, _ = cKDTree(points_N3).query(points_N3, k=2)
        return float(np.median(apart_N2[:, 1]) * np.sqrt(len(self.keys) / self.rows))

    def nearest(self, lat: float, lon: float, count: int) -> Whole:
        """Numbers of the rows nearest to a position, nearest first, at most `count`."""
        known = np.flatnonzero(~np.isnan(self.places_N2).any(axis=1))
        here_13 = on_sphere(np.array([[lat, lon]]))
        away_N = np.linalg.norm(on_sphere(self.places_N2[known]) - here_13, axis=1)
        return np.asarray(known[np.argsort(away_N, kind="stable")[:count]])


def read_gallery_map(index: str) -> GalleryMap:
    """The first rows of an index, at most MOST."""
    columns: dict[str, list[object]] = {"key": [], "location": [], "lat": [], "lon": []}
    with storage.open_read(storage.join(index, IDS)) as stream:
        parquet = pq.ParquetFile(stream)
        for batch in parquet.iter_batches(MOST, columns=list(columns)):
            for name, values in columns.items():
                values.extend(batch[name].to_pylist()[: MOST - len(values)])
            if len(columns["key"]) == MOST:
                break
        rows = parquet.metadata.num_rows
    return GalleryMap(
        keys=np.asarray(columns["key"], dtype=np.str_), locations=np.asarray(columns["location"], dtype=np.str_),
        places_N2=np.array([columns["lat"], columns["lon"]], dtype=np.float64).T.reshape(-1, 2), rows=rows,
    )  # fmt: skip
