"""Which rows of an index may answer: inside a rectangle, around a rough position, of a view, of
some locations.

In: conditions and what is known of the rows. Out: per row whether it may answer. A row without a
position is nowhere. Shapes: N rows.
"""

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.core.arrays import Doubles, Mask
from pipeline.core.geo import Box, Circle, haversine_m
from pipeline.core.records import View


@dataclass(frozen=True, kw_only=True)
class Filter:
    """Conditions that a row meets all of. None: any will do."""

    box: Box | None = None
    near: Circle | None = None
    view: View | None = None
    locations: frozenset[str] | None = None

    def mask(self, rows: pa.RecordBatch) -> Mask:
        """Which rows are meant, by their `view`, `location`, `lat` and `lon`; unknown positions are
        null.
        """
        meant_N = np.ones(len(rows), np.bool_)
        if self.view is not None:
            meant_N &= _to_mask(pc.equal(rows["view"], str(self.view)))
        if self.locations is not None:
            meant_N &= _to_mask(
                pc.is_in(rows["location"], pa.array(sorted(self.locations), pa.string()))
            )
        if self.box or self.near:
            lats_N, lons_N = (
                rows[name].to_numpy(zero_copy_only=False) for name in ("lat", "lon")
            )  # null becomes NaN
            if self.box:
                meant_N &= (self.box.south <= lats_N) & (lats_N <= self.box.north)
                meant_N &= np.any(
                    [(west <= lons_N) & (lons_N <= east) for west, east in self.box.spans()], axis=0
                )
            if self.near:
                meant_N &= _within_circle(lats_N, lons_N, self.near, meant_N)
        return meant_N


def _to_mask(found: pa.Array) -> Mask:
    mask: Mask = found.to_numpy(zero_copy_only=False)
    return mask


def _within_circle(lats_N: Doubles, lons_N: Doubles, near: Circle, asked_N: Mask) -> Mask:
    """Of the rows asked for, those in the circle. Most rows lie outside its band of latitudes and
    cost no trigonometry.
    """
    band = np.degrees(
        near.radius_m / 6_350_000
    )  # a little wider than the circle: no degree of latitude is shorter
    rows = np.flatnonzero(asked_N & (np.abs(lats_N - near.lat) <= band))
    found_N = np.zeros(len(lats_N), np.bool_)
    places_x2 = np.stack([lats_N[rows], lons_N[rows]], axis=1)
    found_N[rows] = haversine_m(places_x2, np.array([near.lat, near.lon])) <= near.radius_m
    return found_N
