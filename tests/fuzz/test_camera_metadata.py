"""EXIF, XMP and KML from anywhere: tags, or a sentence why there are none."""

import io
import struct
from functools import cache
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from pipeline.images.camera_tags import read_tags
from pipeline.images.image_blocks import MetadataBlocks, UnreadableTag, find_metadata
from pipeline.sources.kml import parse_kml
from pipeline.sources.text_tables import Unreadable
from tests.fuzz.bounds import bounded, examples
from tests.fuzz.hostile import damaged, numbers

XMP = """<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"
 drone-dji:GpsLatitude="{0}" drone-dji:GpsLongitude="{1}"
 drone-dji:RelativeAltitude="{2}" drone-dji:GimbalYawDegree="{3}"
 drone-dji:GimbalPitchDegree="{4}"><a><b>{0}</b></a></rdf:Description></rdf:RDF></x:xmpmeta>"""
LAUGHS = "<!DOCTYPE k [<!ENTITY a 'ha'>" + "".join(
    f"<!ENTITY {chr(98 + n)} '{f'&{chr(97 + n)};' * 10}'>" for n in range(12)
) + "]>"  # fmt: skip
OUTSIDE = (
    "<!DOCTYPE k [<!ENTITY a SYSTEM 'file:///etc/passwd'>"
    "<!ENTITY % p SYSTEM 'http://127.0.0.1/x'>%p;]>"
)
KML = """{head}<kml xmlns="http://www.opengis.net/kml/2.2"><Document>
<Placemark><{kind}><coordinates> {0},{1},{2} {3}
</coordinates></{kind}><LookAt><latitude>{1}</latitude><longitude>{0}</longitude></LookAt>
</Placemark></Document></kml>"""
HEADS = [
    "",
    "\ufeff",
    '<?xml version="1.0"?>',
    *(
        f'<?xml version="1.0" encoding="{name}"?>'
        for name in (
            "utf-8",
            "latin-1",
            "utf-16",
            "utf-7",
            "gb2312",
            "shift_jis",
            "big5",
            "cp037",
            "idna",
            "rot13",
            "hex",
            "zip",
            "x",
            "undefined",
        )
    ),
    LAUGHS,
    OUTSIDE,
]
ENCODINGS = ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-32", "latin-1", "cp037"]


@cache
def photo(form: str) -> bytes:
    """A small image with a position and XMP."""
    exif = Image.Exif()
    exif[0x8769] = {0x9003: "2024:05:06 07:08:09", 0x9011: "+02:00", 0x9291: "123"}
    exif[0x8825] = {
        1: "N",
        2: (47.0, 30.0, 1.5),
        3: "E",
        4: (8.0, 30.0, 2.5),
        5: b"\0",
        6: 500.0,
        16: "T",
        17: 12.0,
    }
    stream = io.BytesIO()
    extra: dict[str, Any] = {} if form == "TIFF" else {"exif": exif.tobytes()}
    if form in ("JPEG", "WEBP"):
        extra["xmp"] = XMP.format(47.5, 8.5, "+50.10", 10, -90).encode()
    Image.new("RGB", (16, 16)).save(stream, form, **extra)
    return stream.getvalue()


@given(st.data(), st.sampled_from(["JPEG", "PNG", "WEBP", "TIFF"]), st.booleans())
@examples(60)
def test_photo_with_damaged_tags_is_read_or_rejected(
    data: st.DataObject, form: str, is_intact: bool
) -> None:
    content = data.draw(damaged(photo(form)))
    with bounded(UnreadableTag):
        read_tags(find_metadata(content, is_intact))


@given(st.data(), st.sampled_from(["<", ">"]))
@examples(60)
def test_exif_directories_with_any_pointers_are_bounded(data: st.DataObject, order: str) -> None:
    """EXIF entries of any type, count and offset, among them pointers to themselves."""
    word = st.sampled_from([0, 1, 2, 4, 8, 14, 26, 0xFFFFFFFF, 1 << 20]) | st.integers(0, 2**32 - 1)
    tag = st.sampled_from([1, 2, 3, 4, 5, 6, 16, 17, 0x02BC, 0x8769, 0x8825, 0x9003, 0x9011])
    entries = data.draw(st.lists(st.tuples(tag, st.integers(0, 13), word, word), max_size=12))
    block = {"<": b"II*\0", ">": b"MM\0*"}[order] + struct.pack(order + "IH", 8, len(entries))
    block += b"".join(struct.pack(order + "HHII", *entry) for entry in entries) + data.draw(
        st.binary(max_size=64)
    )
    with bounded(UnreadableTag):
        read_tags(MetadataBlocks(exif=block))


@given(
    st.lists(numbers, min_size=5, max_size=5),
    st.sampled_from(HEADS),
    st.sampled_from(ENCODINGS),
    st.data(),
)
@examples(60)
def test_xmp_packet_is_read_or_rejected(
    cells: list[str], head: str, encoding: str, data: st.DataObject
) -> None:
    packet = (head + XMP.format(*cells)).encode(encoding, "replace")
    with bounded(UnreadableTag):
        read_tags(MetadataBlocks(xmp=packet))
    with bounded(UnreadableTag):
        read_tags(MetadataBlocks(xmp=data.draw(damaged(packet))))


@given(
    st.lists(numbers, min_size=4, max_size=4), st.sampled_from(HEADS), st.sampled_from(ENCODINGS),
    st.sampled_from(["Point", "LineString", "Polygon"]), st.data(),
)  # fmt: skip
@examples(60)
def test_kml_is_read_or_rejected(
    cells: list[str], head: str, encoding: str, kind: str, data: st.DataObject
) -> None:
    content = KML.format(*cells, head=head, kind=kind).encode(encoding, "replace")
    with bounded(Unreadable):
        parse_kml(content)
    with bounded(Unreadable):
        parse_kml(data.draw(damaged(content)))


def test_deeply_nested_kml_points_are_read_in_time() -> None:
    with bounded(Unreadable):
        parse_kml(b"<Point>" * 60_000 + b"</Point>" * 60_000)


def test_number_of_many_digits_is_read_in_time() -> None:
    long = "1" * 500_000 + "x"
    with bounded(UnreadableTag):
        read_tags(MetadataBlocks(xmp=XMP.format(long, long, long, long, long).encode()[: 1 << 20]))
    with bounded(UnreadableTag):
        read_tags(MetadataBlocks(xmp=XMP.format(*["1" * 100_000 + "x"] * 5).encode()))
    with bounded(Unreadable):
        parse_kml(f"<Point><coordinates>{long},1</coordinates></Point>".encode())
