"""KML files, one per location -> geotags by location.

In: a folder that holds `<location>.kml` at any depth. Out: one GeoTag each, and a Rejection for
each file without a usable position. The files are of unknown origin, so they are bounded in size
and depth and may not declare a document type, which is where XML keeps its entities.
"""

import re
from collections.abc import Iterator
from xml.etree.ElementTree import Element

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import GeoTag, Rejection
from pipeline.sources.maps.bounded_xml import UnusableXml, elements, parse_xml
from pipeline.sources.maps.geojson_shapes import centroid, wrap_longitude
from pipeline.sources.text_tables import TagTable, Unreadable, distance_m, parse_position

MAX_KML_BYTES = 1 << 20
"A KML of one placemark has one or two thousand bytes."
SAME_PLACE_M = 1000.0
"Points of one file that are further apart do not describe one location."


def read_kmls(folder: str, tags: TagTable) -> list[Rejection]:
    """Adds the geotags of all KML files to `tags`, by the files' names without `.kml`.

    A file that contradicts an earlier statement of its location is refused. Raises InputError when
    the folder is missing or holds no KML.
    """
    files = {path: size for path, size in _walk(folder) if path.lower().endswith(".kml")}
    if not files:
        raise InputError(
            f"no KML files below {folder}; expected <location>.kml for each location; check --kml"
        )
    rejected = []
    for path, size in files.items():
        full_path = storage.join(folder, path)
        try:
            if size > MAX_KML_BYTES:
                raise Unreadable(f"it has {size} bytes, expected at most {MAX_KML_BYTES}")
            lat, lon = parse_kml(storage.read_bytes(full_path))
            location = path.rsplit("/", 1)[-1][: -len(".kml")]
            tags.add(location, GeoTag(lat=lat, lon=lon))
        except (Unreadable, OSError) as error:
            rejected.append(Rejection(path=full_path, reason="unreadable tag", found=str(error)))
    return rejected


def parse_kml(data: bytes) -> tuple[float, float]:
    """Latitude and longitude of the first Point; without one, of the first LookAt; without one, of
    the middle of the first Polygon; without one, of the first coordinate.

    Raises Unreadable, also where the file holds points that are more than SAME_PLACE_M apart.
    """
    try:
        root = parse_xml(data)
    except UnusableXml as error:
        raise Unreadable(str(error)) from None
    if points := [_first(inner) for inner in _coordinates(root, "Point")]:
        apart = max(distance_m(points[0], point) for point in points)
        if apart > SAME_PLACE_M:
            raise Unreadable(f"{len(points)} points up to {apart:,.0f} m apart, expected one")
        return points[0]
    for look in elements(root, "LookAt"):
        return parse_position(_element_text(look, "latitude"), _element_text(look, "longitude"))
    for inner in _coordinates(root, "Polygon"):
        return _middle(inner)
    for element in elements(root, "coordinates"):
        return _first(element)
    raise Unreadable("no Point, LookAt or coordinates in it")


def _coordinates(root: Element, shape: str) -> Iterator[Element]:
    """The first `coordinates` of each element of a kind: of a Polygon its outer ring."""
    for outer in elements(root, shape):
        yield from (
            inner for _, inner in zip(range(1), elements(outer, "coordinates"), strict=False)
        )


def _positions(element: Element) -> Iterator[tuple[float, float]]:
    """An element's coordinates, which KML writes `longitude,latitude[,altitude]`, separated by
    blanks; some programs write blanks behind the commas too.
    """
    tuples = re.sub(r"\s*,\s*", ",", element.text or "").split() or [""]
    for text in tuples:
        parts = text.split(",")
        if len(parts) < 2:
            raise Unreadable(f"coordinates {element.text!r}, expected longitude,latitude")
        yield parse_position(parts[1], parts[0])


def _first(element: Element) -> tuple[float, float]:
    return next(_positions(element))


def _middle(element: Element) -> tuple[float, float]:
    """The centroid of a ring. Of its corners, those beyond the date line count as beyond it."""
    ring = list(_positions(element))
    near = [(lat, lon + 360 * round((ring[0][1] - lon) / 360)) for lat, lon in ring]
    lat, lon = centroid(tuple(near[:-1] if len(near) > 1 and near[0] == near[-1] else near))
    return lat, wrap_longitude(lon)


def _element_text(element: Element, name: str) -> str:
    return next((inner.text or "" for inner in elements(element, name)), "")


def _walk(folder: str) -> Iterator[tuple[str, int]]:
    if storage.is_folder(folder):
        yield from storage.walk(folder).items()
