"""Camera tags: real headers are understood; hostile ones cost the tags they damage, and no time."""

import io
import struct
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, PngImagePlugin

from pipeline.images.camera_tags import CameraTags, read_tags
from pipeline.images.exif import read_exif
from pipeline.images.image_blocks import (
    EXIF_HEADER,
    XMP_HEADER,
    MetadataBlocks,
    UnreadableTag,
    find_metadata,
)
from pipeline.images.xmp import MAX_DEPTH, read_xmp
from tests.images.metadata_blocks import DJI, PARIS, exif, packet, tags_of

PADDING = b"\n <?xpacket end='w'?>  \n\0\0"
MAKERS = {
    "misspelt attributes": (
        'd:GpsLatitude="+48.8582" d:GpsLongtitude="-2.2945" d:CameraYawDegree="10" '
        'd:CameraPitchDegree="-80"',
        "",
    ),
    "elements": (
        "",
        "<d:GpsLatitude> 48.8582\n</d:GpsLatitude><d:GpsLongitude>-2.2945</d:GpsLongitude>"
        "<d:GimbalYawDegree>+10</d:GimbalYawDegree>"
        "<d:GimbalPitchDegree>-80</d:GimbalPitchDegree>",
    ),
    "structure": (
        's:Latitude="48.8582" s:Longitude="-2.2945"',
        '<s:CameraOrientationNED s:Pitch="-80" s:Yaw="10"/>',
    ),
    "resource": (
        's:Latitude="48.8582" s:Longitude="-2.2945"',
        '<s:CameraOrientationNED rdf:parseType="Resource"><s:Pitch>-80</s:Pitch>'
        "<s:Yaw>10</s:Yaw></s:CameraOrientationNED>",
    ),
    "two frames": (
        's:Latitude="48.8582" s:Longitude="-2.2945"',
        "<s:CameraOrientationFLU><rdf:Description s:Yaw='1' s:Pitch='2'/>"
        "</s:CameraOrientationFLU><s:CameraOrientationNED>"
        "<rdf:Description s:Yaw='10' s:Pitch='-80'/></s:CameraOrientationNED>",
    ),
}
HEADERS = [b"\xff\xd8", b"\x89PNG\r\n\x1a\n", b"RIFF\xff\0\0\0WEBP", b"II*\0", b"MM\0*", b""]
PARIS_POSITION = pytest.approx((48.8582222, 2.2945))


def test_altitude_direction_and_time_are_read() -> None:
    photo = {0x9003: "2024:05:01 12:34:56", 0x9011: "+02:00", 0x9291: "25"}
    tags = tags_of(PARIS | {5: b"\1", 6: 12.5, 16: "T", 17: 271.25}, photo=photo)
    assert (tags.sea_level_m, tags.heading_deg, tags.pitch_deg, tags.height_m) == (
        -12.5,
        271.25,
        None,
        None,
    )
    assert tags.taken_at == "2024-05-01T12:34:56.25+02:00"
    assert tags_of(PARIS | {6: 12.5}).sea_level_m == 12.5
    assert (
        tags_of(photo={0x9003: "2024:05:01 12:34:56", 0x9011: "summer"}).taken_at
        == "2024-05-01T12:34:56"
    )


def test_other_tags_without_sense_are_treated_as_absent() -> None:
    assert tags_of(PARIS | {16: "M", 17: 10.0}).heading_deg is None, "magnetic north is another"
    assert tags_of(PARIS | {17: 400.0}).heading_deg is None
    assert tags_of(photo={0x9003: "0000:00:00 00:00:00"}).taken_at is None
    odd = packet(
        'd:GimbalYawDegree="nan" d:FlightYawDegree="7" d:GimbalPitchDegree="120" '
        'd:RelativeAltitude="1e999"'
    )
    tags = tags_of(PARIS, odd)
    assert (tags.heading_deg, tags.pitch_deg, tags.height_m) == (7, None, None)
    assert tags.position == PARIS_POSITION


@pytest.mark.parametrize(
    "before", ["", "\ufeff", '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n']
)
def test_gimbal_precedes_aircraft_and_take_off_precedes_sea(
    before: str,
) -> None:
    tags = tags_of(PARIS | {17: 33.0}, packet(DJI, before=before) + PADDING)
    assert (tags.height_m, tags.sea_level_m, tags.heading_deg, tags.pitch_deg) == (
        50.10,
        172.40,
        270,
        -60.5,
    )
    flight = tags_of(PARIS, packet('drone-dji:FlightYawDegree="-12"'))
    assert flight.heading_deg == 348
    assert tags_of(PARIS | {17: 33.0}, packet('drone-dji:FlightYawDegree="-12"')).heading_deg == 33
    assert tags_of(PARIS, packet('drone-dji:GimbalPitchDegree="-90.10"')).pitch_deg == -90


@pytest.mark.parametrize(
    ("gps", "attributes", "ignored"),
    [
        ({}, 'd:RelativeAltitude="n/a" d:GimbalYawDegree="10"', ("RelativeAltitude 'n/a'",)),
        ({}, 'd:GimbalPitchDegree="-120"', ("a pitch of -120, not from -90 to 90",)),
        ({}, 'd:GimbalPitchDegree="-90.5"', ()),
        ({17: 33.0, 16: "M"}, "", ("GPSImgDirection from magnetic north",)),
        ({17: 33.0, 16: "M"}, 'd:GimbalYawDegree="10"', ()),  # another tag answers
        ({17: 400.0}, "", ("GPSImgDirection 400, not from 0 to 360",)),
        (
            {},
            'd:GimbalYawDegree="x" d:FlightYawDegree="?"',
            ("GimbalYawDegree 'x'", "FlightYawDegree '?'"),
        ),
    ],
)
def test_tags_that_cannot_be_used_are_all_listed(
    gps: dict[int, object], attributes: str, ignored: tuple[str, ...]
) -> None:
    tags = tags_of(PARIS | gps, packet(attributes))
    assert tags.position == PARIS_POSITION
    assert tags.ignored == ignored


@pytest.mark.parametrize(
    ("taken", "listed"),
    [("0000:00:00 00:00:00", 0), ("    :  :     :  :  ", 0), ("2024-05-01T12:34:56", 1)],
)
def test_time_that_is_no_time_is_listed(taken: str, listed: int) -> None:
    tags = tags_of(photo={0x9003: taken})
    assert tags.taken_at is None
    assert tags.ignored == (f"DateTimeOriginal {taken!r}",) * listed


@pytest.mark.parametrize(("attributes", "elements"), MAKERS.values(), ids=MAKERS)
def test_tags_are_read_in_the_forms_of_all_makers(attributes: str, elements: str) -> None:
    tags = tags_of(xmp=packet(attributes, elements))
    assert (tags.position, tags.heading_deg, tags.pitch_deg) == ((48.8582, -2.2945), 10, -80)


@pytest.mark.parametrize("encoding", ["utf-16-be", "utf-16-le", "utf-32-be", "utf-32-le"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
@pytest.mark.parametrize("padding", ["", " \n\0"])
def test_xmp_in_two_or_four_bytes_a_character_is_read(
    encoding: str, mark: str, padding: str
) -> None:
    text = packet(DJI).decode()
    declared = f'<?xml version="1.0" encoding="UTF-16"?>{text[text.index("<x:xmpmeta") :]}'
    for written in (text, declared):
        wide = f"{mark}{written}{padding}".encode(encoding)
        assert read_xmp(wide) == read_xmp(packet(DJI))


def test_xmp_with_a_doctype_is_refused_in_any_encoding() -> None:
    laughs = '<!DOCTYPE x [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]>'
    for hostile in (packet(before=laughs), packet(before=laughs).decode().encode("utf-16")):
        with pytest.raises(UnreadableTag, match="DOCTYPE"):
            read_xmp(hostile)


@pytest.mark.parametrize(
    ("hostile", "found"),
    [
        (b"<a>" * (MAX_DEPTH + 1), "elements within each other"),
        (b"<a>" + b" " * (1 << 20), "XMP of 1048579 bytes"),
        (b"<a b='1'", "not XML"),
        (b"<?xml version='1.0' encoding='martian'?><a/>", "XMP"),
    ],
)
def test_xmp_is_bounded_in_size_and_depth(hostile: bytes, found: str) -> None:
    with pytest.raises(UnreadableTag, match=found):
        read_xmp(hostile)


@pytest.mark.parametrize(
    "broken",
    [packet(DJI)[:-30], packet(DJI).replace(b"+50.10", b"+50\xff10"), b"<!DOCTYPE x>", b"x"],
)
def test_broken_xmp_costs_its_own_tags(broken: bytes) -> None:
    tags = tags_of(PARIS | {17: 33.0}, broken)
    assert tags.position == PARIS_POSITION
    assert (tags.heading_deg, tags.height_m) == (33, None)
    assert tags.ignored[0].startswith("XMP")
    assert read_tags(MetadataBlocks(xmp=broken)) == CameraTags(ignored=tags.ignored)


@pytest.mark.parametrize(
    ("roll", "pitch", "heading"),
    [(180, -90, 280), (-179.9, -89.9, 280), (180, -30, 100), (10, -90, 100), (400, -90, 100)],
)
def test_gimbal_that_rolled_over_turns_the_heading(roll: float, pitch: float, heading: int) -> None:
    """Straight down, a roll of 180 turns the image; a camera that looks ahead still does."""
    attributes = (
        f'd:GimbalYawDegree="100" d:GimbalPitchDegree="{pitch}" d:GimbalRollDegree="{roll}"'
    )
    assert tags_of(xmp=packet(attributes)).heading_deg == heading


def test_truncated_or_circular_exif_costs_its_own_tags() -> None:
    block = exif(PARIS)
    for damaged, found in (
        (block[:30], "directory"),
        (b"lorem ipsum dolor", "not with a TIFF header"),
        (b"MM\0*\0\0\0\x08\xff\xff" + bytes(100), "65535 entries"),
        (b"II*\0" + struct.pack("<IHHHIII", 8, 1, 0x8825, 2, 1, 8, 0), "is of type 2"),
    ):
        tags = read_tags(MetadataBlocks(exif=damaged, xmp=packet(DJI)))
        assert (tags.position, tags.height_m) == (None, 50.1)
        assert found in tags.ignored[0]
    with pytest.raises(UnreadableTag, match="GPSLongitude of EXIF type 5"):
        read_tags(MetadataBlocks(exif=block[:-8]))
    circular = b"II*\0" + struct.pack("<IHHHIII", 8, 1, 0x8825, 4, 1, 8, 8)
    assert read_tags(MetadataBlocks(exif=circular)) == CameraTags()
    huge = b"II*\0" + struct.pack("<IHHHIII", 8, 1, 700, 1, 0xFFFFFFFF, 8, 0)
    assert read_exif(huge).main[700].raw is None
    assert read_tags(MetadataBlocks(exif=b"\0\0")) == CameraTags(), "an empty block"


def test_metadata_is_found_in_every_format_that_carries_it() -> None:
    image, xmp, info = Image.new("RGB", (8, 8)), packet(DJI), PngImagePlugin.PngInfo()
    info.add_itxt("XML:com.adobe.xmp", xmp.decode())
    for kind, options in {
        "JPEG": {"xmp": xmp},
        "WEBP": {"xmp": xmp},
        "PNG": {"pnginfo": info},
        "TIFF": {"tiffinfo": {700: xmp}},
    }.items():
        stream = io.BytesIO()
        if kind == "TIFF":
            image.save(stream, kind, **options)  # type: ignore[arg-type]
        else:
            block = EXIF_HEADER + exif(PARIS)
            image.save(stream, kind, exif=block, **options)  # type: ignore[arg-type]
        tags = read_tags(find_metadata(stream.getvalue(), complete=True))
        assert tags.height_m == 50.1, kind
        assert kind == "TIFF" or tags.position == pytest.approx((48.8582222, 2.2945)), kind


def test_truncated_beginning_differs_from_absent_tags() -> None:
    stream = io.BytesIO()
    Image.new("RGB", (8, 8)).save(stream, "JPEG", exif=EXIF_HEADER + exif(PARIS))
    data = stream.getvalue()
    assert find_metadata(data[:60], complete=False) == MetadataBlocks(truncated=True)
    assert not find_metadata(data[:-9], complete=False).truncated, "the scan is of no interest"
    assert find_metadata(b"MM\0*" + bytes(9), complete=False) == MetadataBlocks(truncated=True)
    assert find_metadata(b"no image", complete=True) == MetadataBlocks()


def segment(content: bytes) -> bytes:
    return b"\xff\xe1" + (len(content) + 2).to_bytes(2) + content


@settings(max_examples=300)
@given(st.sampled_from(HEADERS), st.binary(max_size=600), st.booleans())
def test_any_bytes_give_tags_or_one_error(header: bytes, data: bytes, complete: bool) -> None:
    check_tags(header + data, complete)


@pytest.mark.slow
@settings(max_examples=300)
@given(
    st.lists(st.tuples(st.integers(0, 1500), st.integers(0, 255)), min_size=1, max_size=8),
    st.integers(20, 1500),
)
def test_damaged_photo_gives_tags_or_one_error(damage: list[tuple[int, int]], length: int) -> None:
    photo = {0x9003: "2024:05:01 12:34:56", 0x9011: "+02:00"}
    made = segment(EXIF_HEADER + exif(PARIS | {17: 3.5}, photo)) + segment(XMP_HEADER + packet(DJI))
    data = bytearray(b"\xff\xd8" + made + b"\xff\xda")
    for at, value in damage:
        data[at % len(data)] = value
    check_tags(bytes(data[:length]), True)


def check_tags(data: bytes, complete: bool) -> None:
    try:
        tags = read_tags(find_metadata(data, complete))
    except UnreadableTag:
        return
    if tags.position is not None:
        assert abs(tags.position[0]) <= 90
        assert abs(tags.position[1]) <= 180
    assert tags.heading_deg is None or 0 <= tags.heading_deg < 360
    assert tags.pitch_deg is None or -90 <= tags.pitch_deg <= 90


def test_worst_headers_take_milliseconds() -> None:
    many = b"MM\0*\0\0\0\x08\xff\xff" + b"\x02\xbc\0\x01\0\0\0\x01\0\0\0\0" * 65535
    flat = packet("".join(f'd:p{n}="{n}" ' for n in range(50_000)))
    began = time.perf_counter()
    check_tags(many, True)
    check_tags(b"\xff\xd8" + b"\xff" * 256_000, False)
    check_tags(b"\xff\xd8" + segment(b"") * 60_000, False)
    read_xmp(flat)
    assert time.perf_counter() - began < 5, "seconds on a busy machine; tenths on an idle one"
