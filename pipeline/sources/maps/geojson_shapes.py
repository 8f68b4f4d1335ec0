"""A GeoJSON geometry -> the middle of the ground that it covers and, of a quadrangle, its corners.

In: the decoded `geometry` member. Out: a Shape in degrees, WGS84, latitude first (GeoJSON has
longitude first). Shapely does the plane geometry, after longitudes were made continuous: a polygon
over the 180th meridian is written in three ways, with longitudes of both signs, with longitudes
beyond 180, or cut into two parts, and all three are the same shape here.
"""

import math
from dataclasses import dataclass
from typing import Any

import shapely
from shapely.errors import ShapelyError
from shapely.geometry.base import BaseGeometry

LatLon = tuple[float, float]
SEAM = 1e-9
"Degrees by which the parts of a cut polygon may fail to meet: 0.1 mm."


@dataclass(frozen=True, kw_only=True)
class Shape:
    """The ground that a geometry covers. Latitudes may still lie beyond 90 degrees."""

    middle: LatLon | None
    """Latitude and longitude of a point, or of a polygon's centroid; None where the geometry cannot
    be read. Its longitude is within 180."""
    corners: tuple[LatLon, ...] = ()
    """Of a polygon with four corners, in the order of the file. Their longitudes are continuous:
    some are beyond 180 where the polygon crosses that meridian."""
    span: float = 0.0
    "Diagonal of its bounding box, degrees; 0 of a point."
    found: str
    "The geometry, or why it cannot be read, for the sentence of an error."


def parse_geometry(geometry: Any) -> Shape | None:
    """None where there is no geometry. Holes of a polygon are ignored."""
    if geometry is None:
        return None
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    if kind not in ("Point", "MultiPoint", "Polygon", "MultiPolygon"):
        return Shape(middle=None, found=f"geometry of type {kind}, not Point or Polygon")
    try:
        coordinates = geometry["coordinates"]
        if not _has_only_numbers(coordinates):
            raise ValueError
        if kind in ("Point", "MultiPoint"):
            return _point(kind, coordinates)
        rings = [coordinates[0]] if kind == "Polygon" else [part[0] for part in coordinates]
        return _polygon(kind, [_continuous([_lat_lon(pair) for pair in ring]) for ring in rings])
    except _Unusable as error:
        return Shape(middle=None, found=f"{kind} {error}")
    except (KeyError, IndexError, TypeError, ValueError, OverflowError, ShapelyError):
        return Shape(middle=None, found=f"{kind} without coordinates that are numbers")


class _Unusable(Exception):
    """A geometry of numbers that does not cover one piece of ground; the message says why."""


def _point(kind: str, coordinates: Any) -> Shape:
    if kind == "MultiPoint" and len(coordinates) != 1:
        raise _Unusable(f"of {len(coordinates)} points, expected one")
    lat, lon = _lat_lon(coordinates if kind == "Point" else coordinates[0])
    return Shape(middle=(lat, wrap_longitude(lon)), found=f"Point {lon}, {lat}")


def _polygon(kind: str, rings: list[list[LatLon]]) -> Shape:
    """The one polygon of some rings, which are its parts."""
    if not rings:
        raise _Unusable("without a part")
    ring = rings[0] if len(rings) == 1 else _joined(rings)
    corners = tuple(ring[:-1] if len(ring) > 1 and ring[0] == ring[-1] else ring)
    lat, lon = centroid(corners)
    middle = (lat, wrap_longitude(lon))
    lats, lons = zip(*corners, strict=True)
    return Shape(
        middle=middle,
        corners=corners if len(corners) == 4 else (),
        span=math.hypot(max(lats) - min(lats), max(lons) - min(lons)),
        found=f"{kind} around {middle}",
    )


def _joined(rings: list[list[LatLon]]) -> list[LatLon]:
    """The outline of parts that meet, as a polygon is cut at the 180th meridian [RFC 7946, 3.1.9].
    Raises _Unusable where they do not meet.
    """
    first = rings[0][0][1]
    parts: list[BaseGeometry] = []
    for ring in rings:
        middle = sum(lon for _, lon in ring) / len(ring)
        shift = 360 * round((first - middle) / 360)
        parts.append(shapely.Polygon([(lat, lon + shift) for lat, lon in ring]).buffer(SEAM))
    union = shapely.union_all(parts).buffer(-SEAM, join_style="mitre")
    if union.geom_type != "Polygon" or union.is_empty:
        raise _Unusable(f"of {len(rings)} separate parts, expected one")
    # The corners on the seam lie on a straight side now.
    outline = shapely.remove_repeated_points(union.simplify(10 * SEAM), 10 * SEAM)
    return [(lat, lon) for lat, lon in outline.exterior.coords]


def _continuous(ring: list[LatLon]) -> list[LatLon]:
    """The ring with longitudes that go on beyond 180 where it crosses that meridian: of two ways
    from one corner to the next the shorter one is meant. Raises _Unusable for a ring that ends on
    another turn than it began.
    """
    found = ring[:1]
    for lat, lon in ring[1:]:
        found.append((lat, lon + 360 * round((found[-1][1] - lon) / 360)))
    if ring and ring[0] == ring[-1] and found[0] != found[-1]:
        raise _Unusable("around a pole, expected one that a map in degrees can show")
    lons = [lon for _, lon in ring]
    if ring and max(lons) - min(lons) >= 360 and not shapely.Polygon(found).area:
        raise _Unusable("around the whole Earth")
    return found


def _has_only_numbers(value: Any, depth: int = 0) -> bool:
    """Whether nested lists hold finite numbers alone. Shapely reads texts as numbers too."""
    if isinstance(value, list):
        return depth < 4 and all(_has_only_numbers(inner, depth + 1) for inner in value)
    return type(value) in (int, float) and math.isfinite(value)


def _lat_lon(pair: Any) -> LatLon:
    lon, lat = float(pair[0]), float(pair[1])
    if abs(lon) > 360:
        raise _Unusable(f"with a longitude of {lon:g}, expected -180 to 180")
    return lat, lon


def wrap_longitude(lon: float) -> float:
    """The same meridian within 180 degrees."""
    return lon if abs(lon) <= 180 else (lon + 180) % 360 - 180


def centroid(corners: tuple[LatLon, ...]) -> LatLon:
    """Middle of a polygon's area, in the plane of latitude and longitude; the mean of its corners
    where it has no area. Four corners in an order that crosses itself are taken in their order
    around the middle.

    Raises ValueError where there is no corner.
    """
    if not corners:
        raise ValueError("a polygon without corners")
    mean = tuple(sum(values) / len(corners) for values in zip(*corners, strict=True))
    # Relative to one corner: products of whole degrees would drown the area of a small field.
    lat_0, lon_0 = corners[0]
    ring = [(lat - lat_0, lon - lon_0) for lat, lon in corners]
    if len(ring) < 3:
        return mean[0], mean[1]
    polygon = shapely.Polygon(ring)
    if not polygon.is_valid and len(ring) == 4:
        polygon = polygon.convex_hull
    if polygon.area == 0:
        return mean[0], mean[1]
    return lat_0 + polygon.centroid.x, lon_0 + polygon.centroid.y


def order_footprint(corners: tuple[LatLon, ...], heading_deg: float) -> tuple[LatLon, ...]:
    """Corners clockwise from the image's upper left, where the image's top points to `heading_deg`.

    Right for images taken straight down. Longitudes of `corners` are continuous; those of the
    result are within 180.
    """
    lat_0, lon_0 = centroid(corners)
    turn = math.radians(heading_deg)

    def in_image(corner: LatLon) -> LatLon:
        """Right and up in the image, degrees of latitude."""
        north = corner[0] - lat_0
        east = (corner[1] - lon_0) * math.cos(math.radians(lat_0))
        right = east * math.cos(turn) - north * math.sin(turn)
        return right, east * math.sin(turn) + north * math.cos(turn)

    clockwise = sorted(corners, key=lambda corner: math.atan2(*in_image(corner)))
    first = max(
        range(len(clockwise)),
        key=lambda at: in_image(clockwise[at])[1] - in_image(clockwise[at])[0],
    )
    ordered = clockwise[first:] + clockwise[:first]
    return tuple((lat, wrap_longitude(lon)) for lat, lon in ordered)
