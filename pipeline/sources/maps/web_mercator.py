"""The grid of web maps: where a tile lies. In: zoom, column, row. Out: WGS84.

At zoom z the square of Web Mercator, between +-85.0511 degrees of latitude, is cut into 2^z columns
from 180 degrees west and 2^z rows from the north (TMS counts rows from the south).
"""

import math

from pipeline.core.records import GeoTag

MAX_ZOOM = 30
"Tiles of this zoom are 4 cm wide; larger numbers are no zooms."


def tile_to_degrees(zoom: int, x: float, y: float) -> tuple[float, float]:
    """(lat, lon) of a place in units of tiles from the grid's upper left corner: the inverse of Web
    Mercator on a sphere.

    lon = 360 x / 2^z - 180,  lat = atan(sinh(pi (1 - 2 y / 2^z))).
    """
    side = 2.0**zoom
    return math.degrees(math.atan(math.sinh(math.pi * (1 - 2 * y / side)))), 360 * x / side - 180


def is_on_grid(zoom: int, x: int, y: int) -> bool:
    return max(x, y) < 1 << zoom and min(x, y) >= 0


def flip_row(zoom: int, y: int) -> int:
    """A row counted from the other end: XYZ to TMS and back."""
    return (1 << zoom) - 1 - y


def tile_geotag(zoom: int, x: int, y: int) -> GeoTag:
    """The middle of a tile on the map, and its corners from the upper left clockwise."""
    lat, lon = tile_to_degrees(zoom, x + 0.5, y + 0.5)
    corners = ((x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1))
    return GeoTag(
        lat=lat, lon=lon, footprint=tuple(tile_to_degrees(zoom, *corner) for corner in corners)
    )
