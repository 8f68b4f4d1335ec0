"""Filters of rows by split, view, location and position; used by feature tables, indexes, service.

In: conditions, and rows as Arrow columns. Out: a boolean mask of the rows that meet all conditions,
and the names of the columns that the mask is computed from; and, from the least and greatest values
of some rows, whether one of them may. A row without a position is in no box and in no circle.
Shapes: N rows.
"""

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.core.arrays import Doubles, Mask
from pipeline.core.geo import Box, Circle, haversine_m
from pipeline.core.records import Split, View

METRES_PER_RADIAN = 6_350_000
"A little less than on any meridian, so that a band of latitudes contains the circle inside it."
Bounds = Callable[[str], tuple[Any, Any] | None]
"The least and greatest value of a column among some rows; None where they are not known."


@dataclass(frozen=True, kw_only=True)
class Filter:
    """Conditions on a row, all of which must hold. None: no condition."""

    split: Split | None = None
    view: View | None = None
    locations: frozenset[str] | None = None
    box: Box | None = None
    near: Circle | None = None

    @property
    def columns(self) -> set[str]:
        """Names of the columns that `mask` reads."""
        named = {"split": self.split, "view": self.view, "location": self.locations}
        positions = {"lat", "lon"} if self.box or self.near else set()
        return {name for name, value in named.items() if value is not None} | positions

    def mask(self, rows: pa.Table | pa.RecordBatch) -> Mask:
        """Which rows meet the conditions (N,). A null value meets none."""
        mask_N = np.ones(len(rows), np.bool_)
        for name, value in (("split", self.split), ("view", self.view)):
            if value is not None:
                mask_N &= _to_mask(pc.equal(rows[name].cast(pa.string()), str(value)))
        if self.locations is not None:
            wanted = pa.array(sorted(self.locations), pa.string())
            mask_N &= _to_mask(pc.is_in(rows["location"], wanted))
        if self.box or self.near:
            # A null becomes NaN, which every comparison refuses.
            lat_N, lon_N = (rows[name].to_numpy(zero_copy_only=False) for name in ("lat", "lon"))
            if self.box:
                mask_N &= _within_box(lat_N, lon_N, self.box)
            if self.near:
                mask_N &= _within_circle(lat_N, lon_N, self.near, mask_N)
        return mask_N

    def may_match(self, bounds: Bounds) -> bool:
        """Whether the bounds of some rows leave room for one that meets the conditions: where not,
        none of them need be read. Neighbours on a map mostly lie in neighbouring rows.
        """
        for name, wanted in self._ranges().items():
            found = bounds(name)
            if found and not any(found[0] <= high and low <= found[1] for low, high in wanted):
                return False
        if self.locations is None or not (found := bounds("location")):
            return True
        names = sorted(self.locations)
        first = bisect_left(names, found[0])
        return first < len(names) and names[first] <= found[1]

    def _ranges(self) -> dict[str, list[tuple[Any, Any]]]:
        """For each column with a condition the ranges of values that can meet it."""
        ranges: dict[str, list[tuple[Any, Any]]] = {}
        for name, value in (("split", self.split), ("view", self.view)):
            if value is not None:
                ranges[name] = [(str(value), str(value))]
        if self.near:
            ranges["lat"] = [latitude_band(self.near)]
        if self.box:
            ranges["lat"] = [(self.box.south, self.box.north)]
            ranges["lon"] = self.box.spans()
        return ranges


def latitude_band(circle: Circle) -> tuple[float, float]:
    """Least and greatest latitude, degrees, between which a circle lies."""
    half = float(np.degrees(circle.radius_m / METRES_PER_RADIAN))
    return circle.lat - half, circle.lat + half


def _to_mask(values: Any) -> Mask:
    mask: Mask = pc.fill_null(values, False).to_numpy(zero_copy_only=False)
    return mask


def _within_box(lat_N: Doubles, lon_N: Doubles, box: Box) -> Mask:
    mask_N = (box.south <= lat_N) & (lat_N <= box.north)
    spans = [(west <= lon_N) & (lon_N <= east) for west, east in box.spans()]
    return np.asarray(mask_N & np.any(spans, axis=0))


def _within_circle(lat_N: Doubles, lon_N: Doubles, circle: Circle, candidates_N: Mask) -> Mask:
    """Which of the candidates lie in the circle. Most rows lie outside its band of latitudes, where
    no trigonometry is computed.
    """
    south, north = latitude_band(circle)
    rows = np.flatnonzero(candidates_N & (south <= lat_N) & (lat_N <= north))
    mask_N = np.zeros(len(lat_N), np.bool_)
    positions_x2 = np.stack([lat_N[rows], lon_N[rows]], axis=1)
    centre_2 = np.array([circle.lat, circle.lon])
    mask_N[rows] = haversine_m(positions_x2, centre_2) <= circle.radius_m
    return mask_N
