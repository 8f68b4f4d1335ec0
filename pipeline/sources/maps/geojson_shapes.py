"""A GeoJSON geometry -> the middle of what it covers and, of a quadrangle, its corners.

In: the decoded `geometry` member. Out: a Shape in degrees, WGS84, latitude first (GeoJSON has
longitude first).
"""

import math
from dataclasses import dataclass
from typing import Any

LatLon = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Shape:
    """What a geometry says of a place; coordinates may still lie off the globe."""

    middle: LatLon | None
    """Latitude and longitude of a point or of a polygon's centroid; None where the geometry cannot
    be read."""
    corners: tuple[LatLon, ...] = ()
    "Of a polygon with four corners, in the order of the file."
    found: str
    "What was there, for an error's sentence."


def parse_geometry(geometry: Any) -> Shape | None:
    """None where there is no geometry. A polygon's holes are left out, and it may not cross the
    180th meridian.
    """
    if geometry is None:
        return None
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    try:
        if kind == "Point":
            place = _lat_lon(geometry["coordinates"])
            return Shape(middle=place, found=f"Point {place[1]}, {place[0]}")
        if kind == "Polygon":
            ring = [_lat_lon(pair) for pair in geometry["coordinates"][0]]
            corners = tuple(ring[:-1] if len(ring) > 1 and ring[0] == ring[-1] else ring)
            middle = centroid(corners)
            return Shape(
                middle=middle,
                corners=corners if len(corners) == 4 else (),
                found=f"Polygon around {middle}",
            )
    except (KeyError, IndexError, TypeError, ValueError, OverflowError):
        return Shape(middle=None, found=f"{kind} without coordinates that are numbers")
    return Shape(middle=None, found=f"geometry of type {kind}, not Point or Polygon")


def _lat_lon(pair: Any) -> LatLon:
    lon, lat = pair[0], pair[1]
    if any(type(value) not in (int, float) or not math.isfinite(value) for value in (lon, lat)):
        raise ValueError
    return float(lat), float(lon)


def centroid(corners: tuple[LatLon, ...]) -> LatLon:
    """Middle of a polygon's area, in the plane of latitude and longitude; of one without area, the
    mean of its corners.

    Raises ValueError where there is no corner.
    """
    if not corners:
        raise ValueError("a polygon without corners")
    # Relative to one corner: products of whole degrees would drown a small field's area.
    lat_0, lon_0 = corners[0]
    ring = [(lat - lat_0, lon - lon_0) for lat, lon in corners]
    twice_area = lat_sum = lon_sum = 0.0
    for (lat_a, lon_a), (lat_b, lon_b) in zip(ring, ring[1:] + ring[:1], strict=True):
        cross = lon_a * lat_b - lon_b * lat_a
        twice_area += cross
        lat_sum += (lat_a + lat_b) * cross
        lon_sum += (lon_a + lon_b) * cross
    if twice_area == 0:
        return sum(lat for lat, _ in corners) / len(corners), sum(lon for _, lon in corners) / len(
            corners
        )
    return lat_0 + lat_sum / (3 * twice_area), lon_0 + lon_sum / (3 * twice_area)


def order_footprint(corners: tuple[LatLon, ...], heading_deg: float) -> tuple[LatLon, ...]:
    """Corners clockwise from the image's upper left, where the image's top looks in the direction
    `heading_deg`.

    Right for images taken straight from above.
    """
    lat_0, lon_0 = centroid(corners)
    turn = math.radians(heading_deg)

    def seen(place: LatLon) -> LatLon:
        """Right and up in the image, degrees of latitude."""
        north, east = place[0] - lat_0, (place[1] - lon_0) * math.cos(math.radians(lat_0))
        return east * math.cos(turn) - north * math.sin(turn), east * math.sin(
            turn
        ) + north * math.cos(turn)

    clockwise = sorted(corners, key=lambda place: math.atan2(*seen(place)))
    first = max(
        range(len(clockwise)), key=lambda at: seen(clockwise[at])[1] - seen(clockwise[at])[0]
    )
    return tuple(clockwise[first:] + clockwise[:first])
