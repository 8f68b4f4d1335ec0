"""The projection of a map: positions in, map coordinates, scale bar, meridians and parallels out.

Equirectangular, true to scale at its middle latitude: right for places some hundred metres apart,
at any meridian, and a plain world map for places all over the world.
"""

import math
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Doubles
from pipeline.core.geo import EARTH_RADIUS_M
from pipeline.report.charts import Tick, nice_ticks

MAP_WIDTH, MAP_HEIGHT, MAP_MARGIN = 520, 360, 22
MIN_SPAN_M = 100.0  # across, so that a single place gets a map too
GRID_MIN_SPAN_M = 50_000.0  # below, meridians and parallels tell nothing
METRES_PER_DEGREE = EARTH_RADIUS_M * math.pi / 180


@dataclass(frozen=True, kw_only=True)
class MapSheet:
    """Projects positions to map coordinates."""

    south: float
    north: float
    west: float
    "The map's western edge; longitudes are counted eastwards from it."
    wide: float
    "Degrees of longitude across."
    scale: float
    "Map units per metre, at the middle latitude."

    @classmethod
    def around(cls, at_N2: Doubles) -> "MapSheet":
        """The smallest map of these positions (latitude, longitude)."""
        south, north = float(at_N2[:, 0].min()), float(at_N2[:, 0].max())
        meridians = np.unique(at_N2[:, 1] % 360)
        gaps = np.diff(meridians, append=meridians[0] + 360)
        widest = int(np.argmax(gaps))
        west, wide = float(meridians[(widest + 1) % len(meridians)]), float(360 - gaps[widest])
        if wide > 180:  # places all over the world: an ordinary world map
            west, wide = -180.0, 360.0
        shrink = math.cos(math.radians((south + north) / 2))
        tall_m = (north - south) * METRES_PER_DEGREE
        wide_m = wide * METRES_PER_DEGREE * shrink
        scale = min(
            (MAP_WIDTH - 2 * MAP_MARGIN) / max(wide_m, MIN_SPAN_M),
            (MAP_HEIGHT - 2 * MAP_MARGIN) / max(tall_m, MIN_SPAN_M),
        )
        return cls(south=south, north=north, west=west, wide=wide, scale=scale)

    @property
    def _shrink(self) -> float:
        return math.cos(math.radians((self.south + self.north) / 2))

    def x(self, lon: float) -> float:
        east = (lon - self.west) % 360
        if east > (360 + self.wide) / 2:  # rounding may put the first meridian behind the last
            east -= 360
        return round(
            MAP_WIDTH / 2 + (east - self.wide / 2) * METRES_PER_DEGREE * self._shrink * self.scale,
            1,
        )

    def y(self, lat: float) -> float:
        return round(
            MAP_HEIGHT / 2 - (lat - (self.south + self.north) / 2) * METRES_PER_DEGREE * self.scale,
            1,
        )

    def xy(self, at_N2: Doubles) -> list[tuple[float, float]]:
        return [(self.x(lon), self.y(lat)) for lat, lon in at_N2.tolist()]

    def bar(self) -> tuple[float, str]:
        """The longest round distance within a third of the map: its length there, and its label."""
        most = MAP_WIDTH / 3 / self.scale
        unit = 10.0 ** math.floor(math.log10(most))
        length = max(step * unit for step in (1, 2, 5) if step * unit <= most)
        return round(length * self.scale, 1), format_metres(length)

    def meridians(self) -> tuple[Tick, ...]:
        """Round longitudes across a map of a country or more."""
        ticks = nice_ticks(self.west, self.west + self.wide) if self._wants_grid() else []
        inside = [lon for lon in ticks if self.west <= lon <= self.west + self.wide]
        return tuple(
            Tick(at=self.x(lon), label=_degrees((lon + 180) % 360 - 180, "EW")) for lon in inside
        )

    def parallels(self) -> tuple[Tick, ...]:
        ticks = nice_ticks(self.south, self.north) if self._wants_grid() else []
        inside = [lat for lat in ticks if self.south <= lat <= self.north]
        return tuple(Tick(at=self.y(lat), label=_degrees(lat, "NS")) for lat in inside)

    def _wants_grid(self) -> bool:
        return MAP_WIDTH / self.scale >= GRID_MIN_SPAN_M


def _degrees(value: float, letters: str) -> str:
    return f"{abs(value):g}°" + (f" {letters[value < 0]}" if value else "")


def format_metres(value: float) -> str:
    """A distance to two digits, with its unit: 12 m, 1.2 km, 3,400 km."""
    if value < 999.5:
        return f"{value:.0f} m"
    return f"{value / 1000:.2g} km" if value < 9_950 else f"{value / 1000:,.0f} km"
