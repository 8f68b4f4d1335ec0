"""The grid of web maps: the positions of its tiles. In: zoom, column, row. Out: WGS84.

At zoom z the square of Web Mercator, between +-85.0511 degrees of latitude, is cut into 2^z columns
from 180 degrees west and 2^z rows from the north (TMS counts rows from the south).
"""

import math

from pipeline.core.records import GeoTag

MAX_ZOOM = 30
"Tiles of this zoom are 4 cm wide; larger numbers are not zooms."
MERCATOR_HALF_M = math.pi * 6_378_137.0
"Half the side of the square, in the metres of EPSG:3857."


def tile_to_degrees(zoom: int, x: float, y: float) -> tuple[float, float]:
    """(lat, lon) of a position in units of tiles from the grid's upper left corner: the inverse of
    Web Mercator on a sphere.

    lon = 360 x / 2^z - 180,  lat = atan(sinh(pi (1 - 2 y / 2^z))).
    """
    side = 2.0**zoom
    lat = math.degrees(math.atan(math.sinh(math.pi * (1 - 2 * y / side))))
    return lat, 360 * x / side - 180


def row_of_latitude(zoom: int, lat: float) -> int:
    """The row, from the north, that a latitude lies in; on the grid for latitudes beyond it."""
    side = 1 << zoom
    clipped = math.radians(max(-85.06, min(85.06, lat)))
    y = (1 - math.asinh(math.tan(clipped)) / math.pi) / 2 * side
    return max(0, min(side - 1, math.floor(y)))


def is_on_grid(zoom: int, x: int, y: int) -> bool:
    return max(x, y) < 1 << zoom and min(x, y) >= 0


def flip_row(zoom: int, y: int) -> int:
    """A row counted from the other end: XYZ to TMS and back."""
    return (1 << zoom) - 1 - y


def tile_geotag(zoom: int, x: int, y: int) -> GeoTag:
    """The middle of a tile on the map, and its corners from the upper left clockwise."""
    lat, lon = tile_to_degrees(zoom, x + 0.5, y + 0.5)
    corners = ((x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1))
    footprint = tuple(tile_to_degrees(zoom, *corner) for corner in corners)
    return GeoTag(lat=lat, lon=lon, footprint=footprint)
