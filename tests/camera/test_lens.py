"""The field of view from a photo's tags, and degrees against pyproj, and propagated errors."""

import numpy as np
import pytest
from pyproj import Geod

from pipeline.camera.ground import looked_at
from pipeline.camera.lens import field_of_view, focal_length_35mm
from pipeline.camera.local_plane import LocalPlane
from pipeline.camera.pose import PartialPose, Pose
from pipeline.camera.uncertainty import PoseErrors, ellipse_of, looked_at_covariance


def test_field_of_view_by_each_statement() -> None:
    size = (4000, 3000)
    # The Mavic 2 Pro states 28 mm equivalent, 10.3 mm, and 77 degrees along the diagonal.
    equivalent = field_of_view(size, focal_35mm=28)
    assert equivalent == pytest.approx(63.4, abs=0.1)
    assert field_of_view(size, focal_mm=10.26, model="L1D-20c") == pytest.approx(65.5, abs=0.1)
    assert field_of_view(size, focal_px=2000, focal_35mm=28) == pytest.approx(90)
    assert field_of_view(size, focal_mm=10.26, model="unheard of") is None
    assert field_of_view(size) is None


def test_field_of_view_of_an_upright_photo_is_narrower() -> None:
    assert field_of_view((3000, 4000), focal_mm=10, model="FC6310") == pytest.approx(52.7, abs=0.1)


@pytest.mark.parametrize("lat", [-45.0, 0.0, 52.0, 78.0])
def test_local_plane_agrees_with_the_ellipsoid(lat: float) -> None:
    plane = LocalPlane(lat=lat, lon=179.99)
    for east, north in ((1000.0, 0.0), (-300.0, 800.0), (0.0, -1500.0)):
        [[found_lat, found_lon]] = plane.to_degrees(np.array([[east, north]]))
        _, _, metres = Geod(ellps="WGS84").inv(179.99, lat, found_lon, found_lat)
        assert metres == pytest.approx(np.hypot(east, north), abs=0.6)
        back = plane.to_metres(np.array([[found_lat, found_lon]]))
        np.testing.assert_allclose(back, [[east, north]], atol=1e-6)


def test_errors_are_those_of_many_drawn_poses() -> None:
    pose = Pose(x_m=0, y_m=0, altitude_m=100, heading_deg=30, pitch_deg=-60, fov_deg=60)
    errors = PoseErrors(heading_deg=3, pitch_deg=1, height_share=0.03, position_m=2)
    rng = np.random.default_rng(0)
    drawn = np.array([
        looked_at(Pose(
            x_m=2 * rng.normal(), y_m=2 * rng.normal(), altitude_m=100 + 3 * rng.normal(),
            heading_deg=30 + 3 * rng.normal(), pitch_deg=-60 + rng.normal(), fov_deg=60,
        )) for _ in range(4000)
    ])  # fmt: skip
    covariance_22 = looked_at_covariance(pose, errors)
    np.testing.assert_allclose(np.cov(drawn.T), covariance_22, atol=1.0)
    ellipse = ellipse_of(covariance_22)
    share = (
        np.einsum("ni,ij,nj->n", drawn - looked_at(pose), np.linalg.inv(covariance_22),
                  drawn - looked_at(pose)) < 2.4477**2
    ).mean()  # fmt: skip
    assert share == pytest.approx(0.95, abs=0.02)
    assert ellipse.major_m > ellipse.minor_m
    assert 0 <= ellipse.direction_deg < 180


def test_ellipse_points_along_the_larger_error() -> None:
    ellipse = ellipse_of(np.array([[1.0, 0.0], [0.0, 4.0]]))
    assert ellipse.direction_deg == pytest.approx(0)
    assert ellipse.major_m == pytest.approx(2 * ellipse.minor_m)


def test_partial_pose_says_what_it_lacks() -> None:
    known = PartialPose(heading_deg=10, pitch_deg=-90, height_m=50)
    assert not known.complete
    with pytest.raises(ValueError, match="field of view"):
        known.over()


def test_35mm_equivalent_is_the_inverse_of_the_field_of_view() -> None:
    fov = field_of_view((4000, 3000), focal_35mm=24)
    assert fov is not None
    assert focal_length_35mm(fov, (4000, 3000)) == pytest.approx(24)
