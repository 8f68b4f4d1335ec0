"""Camera tags: real headers are understood, hostile ones give one documented error and cost
nothing.
"""

import io
import struct
import time
from fractions import Fraction
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, PngImagePlugin

from pipeline.images.camera_tags import CameraTags, parse_number, read_tags
from pipeline.images.exif import read_exif
from pipeline.images.image_blocks import (
    EXIF_HEADER,
    XMP_HEADER,
    MetadataBlocks,
    UnreadableTag,
    find_metadata,
)
from pipeline.images.xmp import MAX_DEPTH, read_xmp

PARIS = {1: "N", 2: (48.0, 51.0, 29.6), 3: "E", 4: (2.0, 17.0, 40.2)}
"48 + 51 / 60 + 29.6 / 3600 = 48.8582222; 2 + 17 / 60 + 40.2 / 3600 = 2.2945"
DJI = (
    'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:AbsoluteAltitude="+172.40" '
    'drone-dji:RelativeAltitude="+50.10" drone-dji:GimbalYawDegree="-90.00" drone-dji:FlightYawDegree="+12.00" '
    'drone-dji:GimbalPitchDegree="-60.50"'
)


def exif(gps: dict[int, Any] | None = None, photo: dict[int, Any] | None = None) -> bytes:
    made = Image.Exif()
    for pointer, tags in ((0x8825, gps), (0x8769, photo)):
        if tags:
            made.get_ifd(pointer).update(tags)
    return made.tobytes().removeprefix(EXIF_HEADER)


def packet(attributes: str = "", elements: str = "", before: str = "") -> bytes:
    return (
        f'{before}<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" {attributes}>{elements}</rdf:Description></rdf:RDF></x:xmpmeta>'
    ).encode()


def gps_block(lat: list[tuple[int, int]], lon: list[tuple[int, int]], refs: str = "NE") -> bytes:
    """An EXIF block by hand, as no library writes such rationals: header, main directory at 8, GPS
    at 26, values at 80.
    """
    main = struct.pack("<HHHIII", 1, 0x8825, 4, 1, 26, 0)
    entries = [(1, 2, 2, refs[0].encode() + b"\0\0\0"), (2, 5, len(lat), struct.pack("<I", 80))]
    entries += [
        (3, 2, 2, refs[1].encode() + b"\0\0\0"),
        (4, 5, len(lon), struct.pack("<I", 80 + 8 * len(lat))),
    ]
    gps = (
        struct.pack("<H", 4)
        + b"".join(struct.pack("<HHI", *entry[:3]) + entry[3] for entry in entries)
        + bytes(4)
    )
    values = b"".join(struct.pack("<II", *pair) for pair in lat + lon)
    return b"II*\0" + struct.pack("<I", 8) + main + gps + values


def of(gps: dict[int, Any] | None = None, xmp: bytes | None = None, **more: Any) -> CameraTags:
    return read_tags(MetadataBlocks(exif=exif(gps, **more), xmp=xmp))


def test_degrees_minutes_and_seconds_become_a_position() -> None:
    assert of(PARIS).position == pytest.approx((48.8582222, 2.2945))
    assert of(PARIS | {1: "S", 3: "W"}).position == pytest.approx((-48.8582222, -2.2945))
    assert of({1: "N", 2: (48.5, 0.0, 0.0), 3: "E", 4: (2.0, 30.0, 0.0)}).position == (48.5, 2.5)


def test_a_photo_without_a_fix_has_no_position() -> None:
    assert read_tags(MetadataBlocks()) == CameraTags()
    assert of({0: b"\x02\x03\0\0"}).position is None
    assert of({2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0)}).position is None
    assert (
        of(xmp=packet('drone-dji:GpsLatitude="0.0000000" drone-dji:GpsLongitude="+0.0"')).position
        is None
    )
    assert of(xmp=packet('drone-dji:GpsLatitude="" drone-dji:GpsLongitude=""')).position is None


@pytest.mark.parametrize(
    ("gps", "found"),
    [
        (PARIS | {2: (95.0, 0.0, 0.0)}, "latitude 95.0"),
        (PARIS | {4: (181.0, 0.0, 0.0)}, "longitude 181.0"),
        (PARIS | {2: (48.0, 75.0, 0.0)}, "GPSLatitude 48/1 75/1 0/1"),
        (PARIS | {1: "X"}, "GPSLatitudeRef is 'X', not N or S"),
        ({name: PARIS[name] for name in (2, 3, 4)}, "GPSLatitudeRef is '', not N or S"),
        ({name: PARIS[name] for name in (1, 2)}, "a position without GPSLongitude"),
        ({name: PARIS[name] for name in (3, 4)}, "a position without GPSLatitude"),
    ],
)
def test_an_impossible_position_is_an_error_that_says_what_was_found(
    gps: dict[int, Any], found: str
) -> None:
    with pytest.raises(UnreadableTag, match=found):
        of(gps)


def test_rationals_over_nothing_are_no_numbers() -> None:
    whole = [(48, 1), (30, 1), (0, 1)]
    assert read_tags(MetadataBlocks(exif=gps_block(whole, whole, "SW"))).position == (-48.5, -48.5)
    with pytest.raises(UnreadableTag, match="GPSLatitude 48/1 30/1 0/0"):
        read_tags(MetadataBlocks(exif=gps_block([(48, 1), (30, 1), (0, 0)], whole)))
    with pytest.raises(UnreadableTag, match="GPSLongitude 1/0 0/1 0/1"):
        read_tags(MetadataBlocks(exif=gps_block(whole, [(1, 0), (0, 1), (0, 1)])))
    with pytest.raises(UnreadableTag, match="not three rationals"):
        read_tags(MetadataBlocks(exif=gps_block(whole, whole[:2])))


@given(st.integers(-90 * 10**7, 90 * 10**7), st.integers(-180 * 10**7, 180 * 10**7))
def test_a_position_comes_back_from_its_rationals(lat: int, lon: int) -> None:
    def rationals(value: int) -> list[tuple[int, int]]:
        """Whole degrees, whole minutes, and the rest of a value in 1e-7 degrees, exactly."""
        degrees, rest = divmod(abs(value), 10**7)
        minutes, rest = divmod(60 * rest, 10**7)
        seconds = Fraction(60 * rest, 10**7)
        return [(degrees, 1), (minutes, 1), (seconds.numerator, seconds.denominator)]

    block = gps_block(
        rationals(lat), rationals(lon), ("S" if lat < 0 else "N") + ("W" if lon < 0 else "E")
    )
    found = read_tags(MetadataBlocks(exif=block)).position
    assert found == (pytest.approx((lat / 1e7, lon / 1e7), abs=1e-12) if lat or lon else None)


def test_altitude_direction_and_time_are_read() -> None:
    photo = {0x9003: "2024:05:01 12:34:56", 0x9011: "+02:00", 0x9291: "25"}
    tags = of(PARIS | {5: b"\1", 6: 12.5, 16: "T", 17: 271.25}, photo=photo)
    assert (tags.sea_level_m, tags.heading_deg, tags.pitch_deg, tags.height_m) == (
        -12.5,
        271.25,
        None,
        None,
    )
    assert tags.taken_at == "2024-05-01T12:34:56.25+02:00"
    assert of(PARIS | {6: 12.5}).sea_level_m == 12.5
    assert (
        of(photo={0x9003: "2024:05:01 12:34:56", 0x9011: "summer"}).taken_at
        == "2024-05-01T12:34:56"
    )


def test_other_tags_without_sense_are_taken_for_absent() -> None:
    assert of(PARIS | {16: "M", 17: 10.0}).heading_deg is None, "magnetic north is another"
    assert of(PARIS | {17: 400.0}).heading_deg is None
    assert of(photo={0x9003: "0000:00:00 00:00:00"}).taken_at is None
    odd = packet(
        'd:GimbalYawDegree="nan" d:FlightYawDegree="7" d:GimbalPitchDegree="120" d:RelativeAltitude="1e999"'
    )
    tags = of(PARIS, odd)
    assert (tags.heading_deg, tags.pitch_deg, tags.height_m) == (7, None, None)
    assert tags.position == pytest.approx((48.8582222, 2.2945))


@pytest.mark.parametrize(
    "before", ["", "\ufeff", '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n']
)
def test_the_gimbal_goes_before_the_aircraft_and_the_height_above_take_off_before_the_sea(
    before: str,
) -> None:
    tags = of(PARIS | {17: 33.0}, packet(DJI, before=before) + b"\n <?xpacket end='w'?>  \n\0\0")
    assert (tags.height_m, tags.sea_level_m, tags.heading_deg, tags.pitch_deg) == (
        50.10,
        172.40,
        270,
        -60.5,
    )
    flight = of(PARIS, packet('drone-dji:FlightYawDegree="-12"'))
    assert flight.heading_deg == 348
    assert of(PARIS | {17: 33.0}, packet('drone-dji:FlightYawDegree="-12"')).heading_deg == 33
    assert of(PARIS, packet('drone-dji:GimbalPitchDegree="-90.10"')).pitch_deg == -90


@pytest.mark.parametrize(
    ("attributes", "elements"),
    [
        ('d:GpsLatitude="+48.8582" d:GpsLongtitude="-2.2945" d:CameraYawDegree="10" d:CameraPitchDegree="-80"', ""),
        ("", "<d:GpsLatitude> 48.8582\n</d:GpsLatitude><d:GpsLongitude>-2.2945</d:GpsLongitude>"
             "<d:GimbalYawDegree>+10</d:GimbalYawDegree><d:GimbalPitchDegree>-80</d:GimbalPitchDegree>"),
        ('s:Latitude="48.8582" s:Longitude="-2.2945"', '<s:CameraOrientationNED s:Pitch="-80" s:Yaw="10"/>'),
        ('s:Latitude="48.8582" s:Longitude="-2.2945"', '<s:CameraOrientationNED rdf:parseType="Resource"><s:Pitch>-80'
         "</s:Pitch><s:Yaw>10</s:Yaw></s:CameraOrientationNED>"),
        ('s:Latitude="48.8582" s:Longitude="-2.2945"', "<s:CameraOrientationFLU><rdf:Description s:Yaw='1' s:Pitch='2'/>"
         "</s:CameraOrientationFLU><s:CameraOrientationNED><rdf:Description s:Yaw='10' s:Pitch='-80'/>"
         "</s:CameraOrientationNED>"),
    ],
    ids=["misspelt attributes", "elements", "structure", "resource", "two frames"],
)  # fmt: skip
def test_makers_write_one_thing_in_many_ways(attributes: str, elements: str) -> None:
    tags = of(xmp=packet(attributes, elements))
    assert (tags.position, tags.heading_deg, tags.pitch_deg) == ((48.8582, -2.2945), 10, -80)


@pytest.mark.parametrize(
    ("attributes", "found"),
    [
        ('d:GpsLatitude="95" d:GpsLongitude="2"', "latitude 95.0"),
        ('d:GpsLatitude="NaN" d:GpsLongitude="2"', "GpsLatitude NaN"),
        ('d:GpsLatitude="inf" d:GpsLongitude="2"', "GpsLatitude inf"),
        ('d:GpsLatitude="48"', "GpsLatitude 48 without its other half"),
    ],
)
def test_an_impossible_position_in_xmp_is_an_error(attributes: str, found: str) -> None:
    with pytest.raises(UnreadableTag, match=found):
        of(xmp=packet(attributes))


def test_a_doctype_is_refused_in_any_encoding_before_entities_can_grow() -> None:
    laughs = '<!DOCTYPE x [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]>'
    for hostile in (packet(before=laughs), packet(before=laughs).decode().encode("utf-16")):
        with pytest.raises(UnreadableTag, match="DOCTYPE"):
            read_xmp(hostile)


@pytest.mark.parametrize(
    ("hostile", "found"),
    [
        (b"<a>" * (MAX_DEPTH + 1), "elements within each other"),
        (b"<a>" + b" " * (1 << 20), "XMP of 1048579 bytes"),
        (b"<a b='1'", "no XML"),
        (b"<?xml version='1.0' encoding='martian'?><a/>", "XMP"),
    ],
)
def test_xmp_has_bounds(hostile: bytes, found: str) -> None:
    with pytest.raises(UnreadableTag, match=found):
        read_xmp(hostile)


def test_a_truncated_or_circular_exif_block_is_an_error_and_never_a_loop() -> None:
    block = exif(PARIS)
    with pytest.raises(UnreadableTag, match="directory"):
        read_tags(MetadataBlocks(exif=block[:30]))
    with pytest.raises(UnreadableTag, match="GPSLongitude of EXIF type 5"):
        read_tags(MetadataBlocks(exif=block[:-8]))
    with pytest.raises(UnreadableTag, match="not with a TIFF header"):
        read_tags(MetadataBlocks(exif=b"lorem ipsum dolor"))
    circular = b"II*\0" + struct.pack("<IHHHIII", 8, 1, 0x8825, 4, 1, 8, 8)
    assert read_tags(MetadataBlocks(exif=circular)) == CameraTags()
    huge = b"II*\0" + struct.pack("<IHHHIII", 8, 1, 700, 1, 0xFFFFFFFF, 8, 0)
    assert read_exif(huge).main[700].raw is None
    with pytest.raises(UnreadableTag, match="65535 entries"):
        read_tags(MetadataBlocks(exif=b"MM\0*\0\0\0\x08\xff\xff" + bytes(100)))
    assert read_tags(MetadataBlocks(exif=b"\0\0")) == CameraTags(), "an empty block"


def test_blocks_are_found_in_every_kind_of_file_that_carries_them() -> None:
    image, xmp, info = Image.new("RGB", (8, 8)), packet(DJI), PngImagePlugin.PngInfo()
    info.add_itxt("XML:com.adobe.xmp", xmp.decode())
    for kind, options in {
        "JPEG": {"xmp": xmp}, "WEBP": {"xmp": xmp}, "PNG": {"pnginfo": info}, "TIFF": {"tiffinfo": {700: xmp}},
    }.items():  # fmt: skip
        stream = io.BytesIO()
        if kind == "TIFF":
            image.save(stream, kind, **options)  # type: ignore[arg-type]
        else:
            image.save(stream, kind, exif=EXIF_HEADER + exif(PARIS), **options)  # type: ignore[arg-type]
        tags = read_tags(find_metadata(stream.getvalue(), complete=True))
        assert tags.height_m == 50.1, kind
        assert kind == "TIFF" or tags.position == pytest.approx((48.8582222, 2.2945)), kind


def test_a_beginning_that_ends_too_early_is_told_from_a_photo_without_tags() -> None:
    stream = io.BytesIO()
    Image.new("RGB", (8, 8)).save(stream, "JPEG", exif=EXIF_HEADER + exif(PARIS))
    data = stream.getvalue()
    assert find_metadata(data[:60], complete=False) == MetadataBlocks(truncated=True)
    assert not find_metadata(data[:-9], complete=False).truncated, "the scan is of no interest"
    assert find_metadata(b"MM\0*" + bytes(9), complete=False) == MetadataBlocks(truncated=True)
    assert find_metadata(b"no image", complete=True) == MetadataBlocks()


@pytest.mark.parametrize(
    ("text", "value"),
    [("+50.10", 50.1), (" -.5 ", -0.5), ("1e2", 100), ("", None), ("1_0", None), ("nan", None), ("٣", None), ("1e999", None)],
)  # fmt: skip
def test_numbers_are_plain(text: str, value: float | None) -> None:
    assert parse_number(text) == value


def segment(content: bytes) -> bytes:
    return b"\xff\xe1" + (len(content) + 2).to_bytes(2) + content


HEADERS = [b"\xff\xd8", b"\x89PNG\r\n\x1a\n", b"RIFF\xff\0\0\0WEBP", b"II*\0", b"MM\0*", b""]


@settings(max_examples=300)
@given(st.sampled_from(HEADERS), st.binary(max_size=600), st.booleans())
def test_any_bytes_give_tags_or_the_one_error(header: bytes, data: bytes, whole: bool) -> None:
    judge(header + data, whole)


@settings(max_examples=300)
@given(
    st.lists(st.tuples(st.integers(0, 1500), st.integers(0, 255)), min_size=1, max_size=8),
    st.integers(20, 1500),
)
def test_a_damaged_photo_gives_tags_or_the_one_error(
    damage: list[tuple[int, int]], length: int
) -> None:
    photo = {0x9003: "2024:05:01 12:34:56", 0x9011: "+02:00"}
    made = segment(EXIF_HEADER + exif(PARIS | {17: 3.5}, photo)) + segment(XMP_HEADER + packet(DJI))
    data = bytearray(b"\xff\xd8" + made + b"\xff\xda")
    for at, value in damage:
        data[at % len(data)] = value
    judge(bytes(data[:length]), True)


def judge(data: bytes, whole: bool) -> None:
    try:
        tags = read_tags(find_metadata(data, whole))
    except UnreadableTag:
        return
    if tags.position is not None:
        assert abs(tags.position[0]) <= 90
        assert abs(tags.position[1]) <= 180
    assert tags.heading_deg is None or 0 <= tags.heading_deg < 360
    assert tags.pitch_deg is None or -90 <= tags.pitch_deg <= 90


def test_the_worst_headers_take_milliseconds() -> None:
    many = b"MM\0*\0\0\0\x08\xff\xff" + b"\x02\xbc\0\x01\0\0\0\x01\0\0\0\0" * 65535
    flat = packet("".join(f'd:p{n}="{n}" ' for n in range(50_000)))
    began = time.perf_counter()
    judge(many, True)
    judge(b"\xff\xd8" + b"\xff" * 256_000, False)
    judge(b"\xff\xd8" + segment(b"") * 60_000, False)
    read_xmp(flat)
    assert time.perf_counter() - began < 5, "seconds on a busy machine; tenths on an idle one"
