"""XML of unknown origin -> a tree, in bounded time and memory.

In: bytes. Out: an element tree no deeper than MAX_XML_DEPTH and without a document type, which is
where XML keeps its entities. Elements are found by their local names, whatever their namespace is.
"""

from collections.abc import Iterator
from xml.etree import ElementTree

MAX_XML_DEPTH = 64
"Nested elements; folders within folders of placemarks have about ten."


class UnusableXml(ValueError):
    """The message says what was found and what was expected."""


class _BoundedTreeBuilder(ElementTree.TreeBuilder):
    _depth = 0

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise UnusableXml(f"it declares a document type ({name}), expected none")

    def start(self, tag: str, attrs: dict[str, str], /) -> ElementTree.Element:
        self._depth += 1
        if self._depth > MAX_XML_DEPTH:
            raise UnusableXml(f"it has more than {MAX_XML_DEPTH} elements within each other")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ElementTree.Element:
        self._depth -= 1
        return super().end(tag)


def parse_xml(data: bytes) -> ElementTree.Element:
    """The root element. Raises UnusableXml."""
    try:
        return ElementTree.fromstring(data, ElementTree.XMLParser(target=_BoundedTreeBuilder()))
    except UnusableXml:
        raise
    # LookupError, ValueError: an unknown encoding.
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise UnusableXml(f"not XML ({error})") from None


def elements(root: ElementTree.Element, name: str) -> Iterator[ElementTree.Element]:
    """All elements of a local name, in document order."""
    return (element for element in root.iter() if str(element.tag).rsplit("}", 1)[-1] == name)
