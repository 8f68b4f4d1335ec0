"""Positions on the earth: distances along the ground, rectangles and circles.

NumPy only, no I/O. Positions are (latitude, longitude) in degrees, WGS84.
Shapes: N positions, 2 = latitude and longitude, 3 = the axes of space.
"""

from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Doubles
from pipeline.core.errors import InputError

EARTH_RADIUS_M = 6_371_008.8
"Mean radius [IUGG]; against the ellipsoid distances err by up to 0.5 %."


def haversine_m(one_x2: Doubles, other_x2: Doubles) -> Doubles:
    """Metres along a great circle between positions.

    Any shapes that broadcast, the last axis being latitude, longitude.
    """
    one, other = np.radians(one_x2), np.radians(other_x2)
    half = (other - one) / 2
    chord = (
        np.sin(half[..., 0]) ** 2
        + np.cos(one[..., 0]) * np.cos(other[..., 0]) * np.sin(half[..., 1]) ** 2
    )
    return np.asarray(2 * EARTH_RADIUS_M * np.arcsin(np.sqrt(np.clip(chord, 0, 1))))


def on_sphere(positions_N2: Doubles) -> Doubles:
    """Latitudes and longitudes as metres from the earth's centre (N, 3), where no meridian and no
    pole is special."""
    lat_N, lon_N = np.radians(positions_N2[:, 0]), np.radians(positions_N2[:, 1])
    axes = np.cos(lat_N) * np.cos(lon_N), np.cos(lat_N) * np.sin(lon_N), np.sin(lat_N)
    return EARTH_RADIUS_M * np.stack(axes, axis=1)


@dataclass(frozen=True, kw_only=True)
class Box:
    """A rectangle of positions, edges included. With `west` above `east` it crosses the meridian of
    180 degrees.

    Raises InputError if it is none.
    """

    south: float
    "Degrees north."
    north: float
    "Degrees north."
    west: float
    "Degrees east, from -180 to 180."
    east: float
    "Degrees east, from -180 to 180."

    def __post_init__(self) -> None:
        latitudes = -90 <= self.south <= self.north <= 90
        if not (latitudes and all(-180 <= lon <= 180 for lon in (self.west, self.east))):
            raise InputError(
                f"the box is south {self.south}, north {self.north}, west {self.west}, east "
                f"{self.east}; expected latitudes from -90 to 90, south below north, and "
                "longitudes from -180 to 180; give west above east to cross 180 degrees"
            )

    def spans(self) -> list[tuple[float, float]]:
        """Its longitudes, as ranges. 180 and -180 are one meridian."""
        west, east = self.west, self.east
        spans = [(west, east)] if west <= east else [(west, 180.0), (-180.0, east)]
        return spans + [(-edge, -edge) for edge in (180.0, -180.0) if edge in (west, east)]


@dataclass(frozen=True, kw_only=True)
class Circle:
    """A circle on the ground around a rough position: what a UAV that has just lost its GPS still
    knows.

    Raises InputError if it is none.
    """

    lat: float
    "Degrees north."
    lon: float
    "Degrees east."
    radius_m: float
    "Metres along the ground."

    def __post_init__(self) -> None:
        centre = -90 <= self.lat <= 90 and -180 <= self.lon <= 180
        if not (centre and 0 < self.radius_m < float("inf")):
            raise InputError(
                f"the circle is at latitude {self.lat}, longitude {self.lon}, radius "
                f"{self.radius_m} m; expected a latitude from -90 to 90, a longitude from -180 to "
                "180 and a radius above 0"
            )
