"""Positions at which the optical axis of a photo meets the ground."""

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.sources.maps.georeference import ELLIPSOID
from pipeline.sources.photos import aim_point
from tests.sources.photo_files import FLOWN, HERE, photo, records

MERIDIAN_M, EQUATOR_M = 110_574.276, 111_319.491
"""Metres of a degree of latitude and of longitude at the equator: pi / 180 times a (1 - e^2) and
times a, with a = 6 378 137 m and e^2 = 0.00669438 [WGS84]."""


def test_project_at_45_degrees_moves_one_height_ahead(tmp_path: Path) -> None:
    """100 m east on the parallel of 33.5 south: 100 / (6 384 650 cos 33.5) radians = 0.0010762
    degrees, with the radius of curvature a / sqrt(1 - e^2 sin^2 33.5) [WGS84].
    """
    photo(tmp_path / "1.jpg", HERE, xmp=FLOWN)
    [record] = records(tmp_path, project=True).values()
    tag = record.geotag
    assert tag is not None
    assert tag.lat == pytest.approx(-33.5, abs=1e-7)
    assert tag.lon == pytest.approx(-70.75 + 0.0010762, abs=1e-7)
    assert (tag.altitude_m, tag.heading_deg, tag.pitch_deg) == (100, 90, -45)


@pytest.mark.parametrize(
    ("old", "new"),
    [(b'"-45.00"', b'"-19.00"'), (b'"+100.00"', b'"-3.00"'), (b"GimbalYaw", b"WindYaw")],
)
def test_project_with_unknown_or_shallow_pose_does_nothing(
    tmp_path: Path, old: bytes, new: bytes
) -> None:
    photo(tmp_path / "1.jpg", HERE, xmp=FLOWN.replace(old, new))
    [record] = records(tmp_path, project=True).values()
    assert record.geotag is not None
    assert (record.geotag.lat, record.geotag.lon) == (-33.5, -70.75)


@pytest.mark.parametrize(
    ("heading", "pitch", "north_m", "east_m"),
    [
        (0, -45, 100, 0),
        (90, -45, 0, 100),
        (180, -45, -100, 0),
        (270, -26.565051177, 0, -200),
        (77, -90, 0, 0),
    ],
)
def test_aim_point_is_height_over_tangent_ahead(
    heading: float, pitch: float, north_m: float, east_m: float
) -> None:
    lat, lon = aim_point(0.0, 10.0, 100.0, heading, pitch)
    expected = (north_m / MERIDIAN_M, 10 + east_m / EQUATOR_M)
    assert (lat, lon) == pytest.approx(expected, abs=1e-9)


@given(
    st.floats(-90, 90),
    st.floats(-180, 180),
    st.floats(0.1, 1e4),
    st.floats(0, 360),
    st.floats(-90, -20),
)
def test_aim_point_is_on_the_globe_at_the_right_distance(
    lat: float, lon: float, height: float, heading: float, pitch: float
) -> None:
    aim_lat, aim_lon = aim_point(lat, lon, height, heading, pitch)
    assert abs(aim_lat) <= 90
    assert -180 <= aim_lon <= 180
    metres = ELLIPSOID.inv(lon, lat, aim_lon, aim_lat)[2]
    assert metres == pytest.approx(height / math.tan(math.radians(-pitch)), abs=1e-3)
