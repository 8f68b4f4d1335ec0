"""The camera's position: every form that cameras write, no fix, contradictions, hostile values."""

import struct
from fractions import Fraction
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.images.camera_position import parse_number
from pipeline.images.camera_tags import CameraTags, read_tags
from pipeline.images.image_blocks import MetadataBlocks, UnreadableTag
from tests.images.metadata_blocks import (
    PARIS,
    angle,
    exif,
    gps_block,
    packet,
    position_block,
    tags_of,
)

OPERA = pytest.approx((-33.8567844, 151.2152967), abs=1e-6)
OPERA_LAT = [(33, 1), (51, 1), (2442384, 100_000)]
OPERA_LON = [(151, 1), (12, 1), (5506812, 100_000)]
OPERA_XMP = packet('d:GpsLatitude="-33.8567844" d:GpsLongitude="151.2152967"')
ZERO, NOTHING = [(0, 1)] * 3, [(0, 0)] * 3


def tags(exif_block: bytes | None, xmp: bytes | None = None) -> CameraTags:
    return read_tags(MetadataBlocks(exif=exif_block, xmp=xmp))


def test_degrees_minutes_seconds_become_a_position() -> None:
    assert tags_of(PARIS).position == pytest.approx((48.8582222, 2.2945))
    assert tags_of(PARIS | {1: "S", 3: "W"}).position == pytest.approx((-48.8582222, -2.2945))
    whole_degrees = {1: "N", 2: (48.5, 0.0, 0.0), 3: "E", 4: (2.0, 30.0, 0.0)}
    assert tags_of(whole_degrees).position == (48.5, 2.5)


@given(st.integers(-90 * 10**7, 90 * 10**7), st.integers(-180 * 10**7, 180 * 10**7))
def test_position_survives_its_fractions(lat: int, lon: int) -> None:
    def fractions(value: int) -> list[tuple[int, int]]:
        """Whole degrees, whole minutes, and the rest of a value in 1e-7 degrees, exactly."""
        degrees, rest = divmod(abs(value), 10**7)
        minutes, rest = divmod(60 * rest, 10**7)
        seconds = Fraction(60 * rest, 10**7)
        return [(degrees, 1), (minutes, 1), (seconds.numerator, seconds.denominator)]

    letters = ("S" if lat < 0 else "N") + ("W" if lon < 0 else "E")
    found = tags(position_block(fractions(lat), fractions(lon), letters)).position
    assert found == (pytest.approx((lat / 1e7, lon / 1e7), abs=1e-12) if lat or lon else None)


@pytest.mark.parametrize(
    ("lat", "lon"),
    [
        ([(33, 1), (5140706, 100_000)], [(151, 1), (1291780, 100_000)]),
        ([(33, 1), (5140706, 100_000), (0, 0)], [(151, 1), (1291780, 100_000), (0, 0)]),
        ([(338567844, 10**7)], [(1512152967, 10**7)]),
        ([(338567844, 10**7), (0, 0), (0, 0)], [(1512152967, 10**7), (0, 1), (0, 1)]),
    ],
    ids=["decimal minutes", "empty seconds", "decimal degrees", "empty minutes"],
)
def test_absent_minutes_and_seconds_are_read(lat: Any, lon: Any) -> None:
    assert tags(position_block(lat, lon, "SE")).position == pytest.approx(
        (-33.8567844, 151.2152967), abs=1e-5
    )


@pytest.mark.parametrize(
    ("kind", "code", "values"),
    [
        (12, "d", (33.8567844,)),
        (12, "d", (33.0, 51.0, 24.42384)),
        (3, "H", (33, 51, 24)),
        (4, "I", (33, 51, 24)),
        (10, "ii", (-33, 1, 51, 1, 2442384, 100_000)),
    ],
)
def test_every_numeric_type_of_tiff_is_read(kind: int, code: str, values: Any) -> None:
    number = len(values) // len(code)
    entry = kind, number, struct.pack("<" + code * number, *values)
    block = gps_block({1: (2, 2, b"S\0"), 2: entry, 3: (2, 2, b"E\0"), 4: angle(OPERA_LON)})
    assert tags(block).position == pytest.approx((-33.8567844, 151.2152967), abs=2e-4)


@pytest.mark.parametrize(("kind", "letters"), [(1, b"S\0"), (7, b"South"), (129, b"s\0")])
def test_letters_of_other_types_are_read(kind: int, letters: bytes) -> None:
    entries = {1: (kind, len(letters), letters), 2: angle(OPERA_LAT), 3: (2, 2, b"E\0")}
    assert tags(gps_block(entries | {4: angle(OPERA_LON)})).position == OPERA


@pytest.mark.parametrize("pointer", [3, 4, 9, 13])
def test_gps_pointer_of_any_integer_type_is_followed(pointer: int) -> None:
    assert tags(position_block(OPERA_LAT, OPERA_LON, "SE", pointer=pointer)).position == OPERA


def test_negative_angle_states_its_hemisphere() -> None:
    south = [(-33, 1), (51, 1), (2442384, 100_000)]
    entries = {2: angle(south, 10), 3: (2, 2, b"E\0"), 4: angle(OPERA_LON)}
    assert tags(gps_block(entries)).position == OPERA
    with pytest.raises(UnreadableTag, match=r"GPSLatitude is -33\.8\d* and GPSLatitudeRef 'N'"):
        tags(gps_block(entries | {1: (2, 2, b"N\0")}))


NO_FIX = {
    "zeros": position_block(ZERO, ZERO),
    "0/0": position_block(NOTHING, NOTHING),
    "0/0 without letters": position_block(NOTHING, NOTHING, "  "),
    "0/10000": position_block([(0, 10_000)] * 3, [(0, 10_000)] * 3, "  "),
    "no values": gps_block({1: (2, 0, b""), 2: (5, 0, b""), 3: (2, 0, b""), 4: (5, 0, b"")}),
    "zero bytes": gps_block({2: (7, 3, bytes(3)), 4: (2, 2, b"  ")}),
    "letters alone": gps_block({1: (2, 2, b"N\0"), 3: (2, 2, b"E\0")}),
    "latitude 0/0 alone": gps_block({2: angle(NOTHING)}),
    "empty directory": gps_block({}),
    "empty pointer": gps_block({}, count=0),
    "version alone": gps_block({0: (1, 4, b"\2\3\0\0")}),
    "no EXIF": b"",
}


@pytest.mark.parametrize("block", NO_FIX.values(), ids=NO_FIX)
def test_photo_without_a_fix_has_no_position(block: bytes) -> None:
    assert tags(block) == CameraTags()
    assert tags(block, OPERA_XMP).position == OPERA


@pytest.mark.parametrize(
    "attributes",
    [
        'd:GpsLatitude="0.0000000" d:GpsLongitude="+0.0"',
        'd:GpsLatitude="" d:GpsLongitude=""',
        'd:GpsLatitude="0" d:GpsLongtitude="0"',
    ],
)
def test_xmp_without_a_fix_has_no_position(attributes: str) -> None:
    assert tags_of(xmp=packet(attributes)).position is None
    assert tags(exif(PARIS), packet(attributes)).position == pytest.approx((48.8582222, 2.2945))


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
def test_impossible_position_is_refused_by_name(gps: dict[int, Any], found: str) -> None:
    with pytest.raises(UnreadableTag, match=found):
        tags_of(gps)
    answered = tags_of(gps, OPERA_XMP)
    assert answered.position == OPERA
    assert found in answered.ignored[0]


def test_fractions_over_zero_are_no_numbers() -> None:
    degrees = [(48, 1), (30, 1), (0, 1)]
    assert tags(position_block(degrees, degrees, "SW")).position == (-48.5, -48.5)
    for lat, lon, found in (
        ([(48, 1), (30, 1), (0, 0)], degrees, "GPSLatitude 48/1 30/1 0/0"),
        (degrees, [(1, 0), (0, 1), (0, 1)], "GPSLongitude 1/0 0/1 0/1"),
        (degrees, degrees[:2], "not three rationals"),
        (NOTHING, degrees, "GPSLatitude 0/0"),
    ):
        with pytest.raises(UnreadableTag, match=found):
            tags(position_block(lat, lon))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1e308])
def test_number_that_is_none_is_refused(value: float) -> None:
    entry = 12, 1, struct.pack("<d", value)
    with pytest.raises(UnreadableTag):
        tags(gps_block({1: (2, 2, b"N\0"), 2: entry, 3: (2, 2, b"E\0"), 4: entry}))


@pytest.mark.parametrize(
    ("attributes", "found"),
    [
        ('d:GpsLatitude="95" d:GpsLongitude="2"', "latitude 95.0"),
        ('d:GpsLatitude="NaN" d:GpsLongitude="2"', "GpsLatitude NaN"),
        ('d:GpsLatitude="inf" d:GpsLongitude="2"', "GpsLatitude inf"),
        ('d:GpsLatitude="48"', "GpsLatitude 48 without its other half"),
        ('exif:GPSLatitude="33,75.0S" exif:GPSLongitude="2,1.0E"', "GPSLatitude 33,75.0S"),
    ],
)
def test_impossible_xmp_position_is_refused(attributes: str, found: str) -> None:
    with pytest.raises(UnreadableTag, match=found):
        tags_of(xmp=packet(attributes))
    assert tags_of(PARIS, packet(attributes)).position == pytest.approx((48.8582222, 2.2945))


@pytest.mark.parametrize(
    ("lat", "lon"),
    [
        ("33,51.407064S", "151,12.917802E"),
        ("33,51,24.42384S", "151,12,55.06812E"),
        ("-33.8567844", "+151.2152967"),
    ],
)
def test_exif_position_within_xmp_is_read(lat: str, lon: str) -> None:
    xmp = packet(f'exif:GPSLatitude="{lat}" exif:GPSLongitude="{lon}"')
    assert tags(None, xmp).position == OPERA


def test_letter_beside_an_xmp_position_is_read() -> None:
    """As in immich-app/immich #3540: 60.5 and 68 with W and N beside them were placed in Russia."""
    west = 'e:GPSLatitude="60.5" e:GPSLatitudeRef="N" e:GPSLongitude="{}" e:GPSLongitudeRef="{}"'
    for number, letter in (("68", "W"), ("-68", "W"), ("-68", "West")):
        assert tags(None, packet(west.format(number, letter))).position == (60.5, -68)
    with pytest.raises(UnreadableTag, match=r"GPSLatitude 60\.5 N, GPSLongitude -68 E"):
        tags(None, packet(west.format("-68", "E")))


@pytest.mark.parametrize(
    ("attributes", "metres"),
    [
        ('d:GpsLatitude="33.8567844" d:GpsLongitude="151.2152967"', "7,529,"),
        ('d:GpsLatitude="-33.8567844" d:GpsLongitude="-151.2152967"', ""),
        ('d:GpsLatitude="-33.8577844" d:GpsLongitude="151.2152967"', "111 m apart"),
        ('exif:GPSLatitude="33,51.407064N" exif:GPSLongitude="151,12.917802E"', "7,529,"),
    ],
    ids=["hemisphere", "west", "next street", "exif in xmp"],
)
def test_contradicting_positions_are_refused(attributes: str, metres: str) -> None:
    sentence = f"EXIF has latitude -33.8567844, longitude 151.2152967 and XMP .*{metres}"
    with pytest.raises(UnreadableTag, match=sentence):
        tags(position_block(OPERA_LAT, OPERA_LON, "SE"), packet(attributes))


def test_positions_that_differ_by_rounding_agree() -> None:
    whole = [(33, 1), (51, 1), (24, 1)], [(151, 1), (12, 1), (55, 1)]
    assert tags(position_block(*whole, "SE"), OPERA_XMP).position == pytest.approx(
        (-33.8567, 151.2153), abs=1e-4
    )


@pytest.mark.parametrize(
    ("datum", "lat", "lon"),
    [
        ("WGS-84", 35.0, 139.0),
        ("WGS 84 ", 35.0, 139.0),
        ("JGD2011", 35.0, 139.0),
        ("", 35.0, 139.0),
        ("TOKYO", 35.00326, 138.99683),
    ],
)
def test_datum_near_wgs84_is_kept_and_tokyo_shifted(datum: str, lat: float, lon: float) -> None:
    """Tokyo: about 460 m [the Geospatial Information Authority's TKY2JGD at 35, 139]."""
    here = {1: "N", 2: (35.0, 0.0, 0.0), 3: "E", 4: (139.0, 0.0, 0.0), 18: datum}
    assert tags_of(here).position == pytest.approx((lat, lon), abs=1e-4)


def test_unknown_datum_is_named() -> None:
    with pytest.raises(UnreadableTag, match=r"GPSMapDatum is 'Pulkovo 1942', expected WGS-84"):
        tags_of(PARIS | {18: "Pulkovo 1942"})


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("+50.10", 50.1), (" -.5 ", -0.5), ("1e2", 100), ("", None), ("1_0", None), ("nan", None),
        ("٣", None), ("1e999", None),
    ],
)  # fmt: skip
def test_numbers_are_plain(text: str, value: float | None) -> None:
    assert parse_number(text) == value
