"""Which rows of an index may answer: inside a rectangle, around a rough position, of a view, of some locations.

In: conditions and what is known of the rows. Out: per row whether it may answer. A row without a position is nowhere.
Shapes: N rows.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.feature_selection import Box
from pipeline.metrics import Doubles
from pipeline.positions import haversine_m
from pipeline.records import InputError, View

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class Near:
    """A circle on the ground round a rough position: what a UAV that has just lost its GPS still knows.

    Raises InputError when it is none.
    """

    lat: float
    "Degrees north."
    lon: float
    "Degrees east."
    radius_m: float
    "Metres along the ground."

    def __post_init__(self) -> None:
        if not (-90 <= self.lat <= 90 and -180 <= self.lon <= 180 and 0 < self.radius_m < float("inf")):
            raise InputError(
                f"the circle is at latitude {self.lat}, longitude {self.lon}, radius {self.radius_m} m; expected a latitude "
                "from -90 to 90, a longitude from -180 to 180 and a radius above 0"
            )


@dataclass(frozen=True, kw_only=True)
class Where:
    """Conditions that a row meets all of. None: any will do."""

    box: Box | None = None
    near: Near | None = None
    view: View | None = None
    locations: frozenset[str] | None = None

    def mask(self, lats_N: Doubles, lons_N: Doubles, views_N: "Coded", locations_N: "Coded") -> Mask:
        """Which rows are meant. Positions in degrees, NaN where unknown: no comparison with those is true."""
        meant_N = np.ones(len(lats_N), np.bool_)
        if self.view is not None:
            meant_N &= views_N.any_of([str(self.view)])
        if self.locations is not None:
            meant_N &= locations_N.any_of(self.locations)
        if self.box:
            meant_N &= (self.box.south <= lats_N) & (lats_N <= self.box.north)
            meant_N &= np.any([(west <= lons_N) & (lons_N <= east) for west, east in self.box.spans()], axis=0)
        if self.near:
            meant_N &= _within(lats_N, lons_N, self.near, meant_N)
        return meant_N


@dataclass(frozen=True, kw_only=True)
class Coded:
    """A column of names that repeat: each name once, and per row which it is."""

    names: tuple[str, ...]
    code_N: npt.NDArray[np.int32]

    def any_of(self, wanted: Iterable[str]) -> Mask:
        """Which rows have one of these names."""
        chosen = set(wanted)
        known = np.array([name in chosen for name in self.names], np.bool_)
        found: Mask = known[self.code_N] if len(known) else np.zeros(len(self.code_N), np.bool_)
        return found


def _within(lats_N: Doubles, lons_N: Doubles, near: Near, asked_N: Mask) -> Mask:
    """Of the rows asked for, those in the circle. Most rows lie outside its band of latitudes and cost no trigonometry."""
    band = np.degrees(near.radius_m / 6_350_000)  # a little wider than the circle: no degree of latitude is shorter
    rows = np.flatnonzero(asked_N & (np.abs(lats_N - near.lat) <= band))
    found_N = np.zeros(len(lats_N), np.bool_)
    places_x2 = np.stack([lats_N[rows], lons_N[rows]], axis=1)
    found_N[rows] = haversine_m(places_x2, np.array([near.lat, near.lon])) <= near.radius_m
    return found_N
