"""KML files, one per location -> geotags by location.

In: a folder in which, however deep, `<location>.kml` lies. Out: one GeoTag each, and a Rejection
for each file that tells no place. Files come from elsewhere, so they are bounded in size and may
not declare a document type, which is where XML keeps its entities.
"""

from collections.abc import Iterator
from xml.etree import ElementTree

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import GeoTag, Rejection
from pipeline.sources.text_tables import Unreadable, parse_position

MAX_KML_BYTES = 1 << 20
"Bytes. A KML of one placemark has one or two thousand."
MAX_XML_DEPTH = 64
"Elements within elements; folders within folders of placemarks have about ten."


class _BoundedTreeBuilder(ElementTree.TreeBuilder):
    """A tree without a document type, and no deeper than DEEPEST: searching it costs what its size
    says.
    """

    _depth = 0

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise Unreadable(f"it declares a document type ({name}), expected none")

    def start(self, tag: str, attrs: dict[str, str], /) -> ElementTree.Element:
        self._depth += 1
        if self._depth > MAX_XML_DEPTH:
            raise Unreadable(f"it has more than {MAX_XML_DEPTH} elements within each other")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ElementTree.Element:
        self._depth -= 1
        return super().end(tag)


def read_kmls(folder: str) -> tuple[dict[str, GeoTag], list[Rejection]]:
    """Geotags by the files' names without `.kml`.

    Raises InputError when the folder is missing or holds no KML.
    """
    files = {path: size for path, size in _walk(folder) if path.lower().endswith(".kml")}
    if not files:
        raise InputError(
            f"no KML files below {folder}; expected <location>.kml for each location; check --kml"
        )
    tags, rejected = {}, []
    for path, size in files.items():
        whole = storage.join(folder, path)
        try:
            if size > MAX_KML_BYTES:
                raise Unreadable(f"it has {size} bytes, expected at most {MAX_KML_BYTES}")
            lat, lon = parse_kml(storage.read_bytes(whole))
            tags[path.rsplit("/", 1)[-1][: -len(".kml")]] = GeoTag(lat=lat, lon=lon)
        except (Unreadable, OSError) as error:
            rejected.append(Rejection(path=whole, reason="unreadable tag", found=str(error)))
    return tags, rejected


def parse_kml(data: bytes) -> tuple[float, float]:
    """Latitude and longitude of the first Point; without one, of the first LookAt; without one, of
    the first coordinate.

    Raises Unreadable.
    """
    try:
        root = ElementTree.fromstring(data, ElementTree.XMLParser(target=_BoundedTreeBuilder()))
    except Unreadable:
        raise
    except (
        ElementTree.ParseError,
        LookupError,
        ValueError,
    ) as error:  # the last two: an encoding that nobody knows
        raise Unreadable(f"not XML ({error})") from None
    point = next(
        (inner for outer in _elements(root, "Point") for inner in _elements(outer, "coordinates")),
        None,
    )
    if point is not None:
        return _parse_coordinates(point)
    for look in _elements(root, "LookAt"):
        return parse_position(_element_text(look, "latitude"), _element_text(look, "longitude"))
    for coordinates in _elements(root, "coordinates"):
        return _parse_coordinates(coordinates)
    raise Unreadable("no Point, LookAt or coordinates in it")


def _parse_coordinates(element: ElementTree.Element) -> tuple[float, float]:
    """The first of an element's coordinates, which KML writes `longitude,latitude[,altitude]`,
    separated by blanks.
    """
    first = ((element.text or "").split() or [""])[0].split(",")
    if len(first) < 2:
        raise Unreadable(f"coordinates {element.text!r}, expected longitude,latitude")
    return parse_position(first[1], first[0])


def _element_text(element: ElementTree.Element, name: str) -> str:
    return next((inner.text or "" for inner in _elements(element, name)), "")


def _elements(root: ElementTree.Element, name: str) -> Iterator[ElementTree.Element]:
    """All elements of a name in document order, whatever version of KML names them."""
    return (element for element in root.iter() if str(element.tag).rsplit("}", 1)[-1] == name)


def _walk(folder: str) -> Iterator[tuple[str, int]]:
    if storage.is_folder(folder):
        yield from storage.walk(folder).items()
