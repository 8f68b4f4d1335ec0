"""An XMP packet -> its properties as text, by their names without namespace.

In: XML from a file that anyone may have written. Out: a plain dictionary. A packet with a DOCTYPE
is refused, because entities need one; size and depth are bounded. Names count whatever their
namespace: makers use the same names in namespaces of their own, and some forget to declare them.
"""

from xml.parsers import expat

from pipeline.images.image_blocks import UnreadableTag

MAX_PACKET_BYTES = 1 << 20
"A JPEG segment holds 64 kB."
MAX_DEPTH = 32
"Elements within elements; cameras need five."
STRUCTURAL_ELEMENTS = {"xmpmeta", "xapmeta", "RDF", "Description", "Seq", "Bag", "Alt", "li"}
"Elements that hold properties and are none."
WIDE_ENCODINGS = {
    b"\0\0\xfe\xff": "utf-32-be", b"\xff\xfe\0\0": "utf-32-le", b"\xfe\xff": "utf-16-be",
    b"\xff\xfe": "utf-16-le", b"\0\0\0<": "utf-32-be", b"<\0\0\0": "utf-32-le", b"\0<": "utf-16-be",
    b"<\0": "utf-16-le",
}  # fmt: skip
"""How packets begin whose characters have two or four bytes [XMP part 3, 1.1.2]: with a byte order
mark, or the first character of XML. Longer ones first."""


def read_xmp(packet: bytes) -> dict[str, str]:
    """Properties of a packet, written as attributes or as elements; a field of a structure is named
    `structure.field`.

    Of a property that is there twice the first counts. Raises UnreadableTag.
    """
    if len(packet) > MAX_PACKET_BYTES:
        raise UnreadableTag(f"XMP of {len(packet)} bytes, more than {MAX_PACKET_BYTES}")
    properties: dict[str, str] = {}
    path: list[str] = []
    text: list[str] = []

    def begin(name: str, attributes: dict[str, str]) -> None:
        path.append(_local_name(name))
        text.clear()
        if len(path) > MAX_DEPTH:
            raise UnreadableTag(f"XMP with more than {MAX_DEPTH} elements within each other")
        for attribute, value in attributes.items():
            if not attribute.startswith(("xmlns", "rdf:")):
                named = _property_name([*path, _local_name(attribute)])
                properties.setdefault(named, value.strip())

    def end(_: str) -> None:
        value = "".join(text).strip()
        if value:
            properties.setdefault(_property_name(path), value)
        text.clear()
        path.pop()

    def doctype(*_: object) -> None:
        raise UnreadableTag("XMP with a DOCTYPE")

    content, encoding = _narrow(packet)
    parser = expat.ParserCreate(encoding)
    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.CharacterDataHandler = text.append
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise UnreadableTag(f"XMP that is not XML: {error}") from None
    except (ValueError, LookupError) as error:
        if isinstance(error, UnreadableTag):
            raise
        raise UnreadableTag(f"XMP in an unknown encoding: {error}") from None
    return properties


def _narrow(packet: bytes) -> tuple[bytes, str | None]:
    """A packet without the padding that is common at its end, and the encoding that it has whatever
    its XML says; None: as it says.
    """
    for start, encoding in WIDE_ENCODINGS.items():
        if packet.startswith(start):
            text = packet.decode(encoding, "replace").strip("\ufeff\0 \t\r\n")
            return text.encode("utf-8", "replace"), "utf-8"
    return packet.strip(b"\0 \t\r\n"), None


def _local_name(name: str) -> str:
    return name.rpartition(":")[2]


def _property_name(path: list[str]) -> str:
    return ".".join(name for name in path if name not in STRUCTURAL_ELEMENTS)
