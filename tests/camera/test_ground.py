"""The homography between photo and ground: round trips, hand-worked cases, the simulator's rays."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.camera.ground import (
    HorizonInView,
    apply_homography,
    camera_above,
    corners,
    footprint,
    ground_to_photo,
    heading_of,
    looked_at,
    photo_to_ground,
)
from pipeline.camera.pose import Pose
from pipeline.simulation.appearance import Day
from pipeline.simulation.render import RAYS_PER_PIXEL, _rays
from pipeline.simulation.scene import prepare_scene
from pipeline.simulation.town.town import make_town

SIZE = (640, 480)
POSES = st.builds(
    Pose,
    x_m=st.floats(-500, 500),
    y_m=st.floats(-500, 500),
    altitude_m=st.floats(20, 300),
    heading_deg=st.floats(0, 359.9),
    pitch_deg=st.floats(-90, -45),
    fov_deg=st.floats(20, 60),
    roll_deg=st.floats(-10, 10),
)


def test_ground_of_a_photo_straight_down_is_known() -> None:
    pose = Pose(x_m=10, y_m=20, altitude_m=100, heading_deg=0, pitch_deg=-90, fov_deg=90)
    across, down = 100, 75  # half the width is the height, as tan(45 degrees) is 1
    expected = [[-90, 95], [110, 95], [110, -55], [-90, -55]]
    assert expected == [[10 + x * across, 20 + y * down] for x, y in
                        ((-1, 1), (1, 1), (1, -1), (-1, -1))]  # fmt: skip
    np.testing.assert_allclose(footprint(pose, SIZE), expected, atol=1e-9)


def test_ground_of_an_oblique_photo_is_known() -> None:
    pose = Pose(x_m=0, y_m=0, altitude_m=50, heading_deg=90, pitch_deg=-45, fov_deg=60)
    assert looked_at(pose) == pytest.approx((50, 0))
    middle = apply_homography(photo_to_ground(pose, SIZE), np.array([[320.0, 240.0]]))
    np.testing.assert_allclose(middle, [[50, 0]], atol=1e-9)


@given(pose=POSES)
def test_photo_and_ground_are_inverse(pose: Pose) -> None:
    ground_42 = footprint(pose, SIZE)
    back_42 = apply_homography(ground_to_photo(pose, SIZE), ground_42)
    np.testing.assert_allclose(back_42, corners(SIZE), atol=1e-5)


@given(pose=POSES)
def test_camera_is_recovered_from_its_homography(pose: Pose) -> None:
    scaled_33 = -3.7 * photo_to_ground(pose, SIZE)  # a homography has no scale and no sign
    found = camera_above(scaled_33, SIZE, pose.fov_deg)
    assert found == pytest.approx((pose.x_m, pose.y_m, pose.altitude_m), abs=1e-3)


def test_heading_is_where_the_image_points_up() -> None:
    for heading in (0.0, 37.0, 180.0, 301.0):
        pose = Pose(
            x_m=3, y_m=4, altitude_m=80, heading_deg=heading, pitch_deg=-60, fov_deg=50
        )  # fmt: skip
        off = heading_of(photo_to_ground(pose, SIZE), SIZE) - heading
        assert (off + 180) % 360 == pytest.approx(180)


def test_roll_turns_the_image_about_its_axis() -> None:
    level = Pose(x_m=0, y_m=0, altitude_m=80, heading_deg=20, pitch_deg=-90, fov_deg=50)
    rolled = Pose(
        x_m=0, y_m=0, altitude_m=80, heading_deg=20, pitch_deg=-90, fov_deg=50, roll_deg=15
    )  # fmt: skip
    turned = heading_of(photo_to_ground(rolled, SIZE), SIZE) - heading_of(
        photo_to_ground(level, SIZE), SIZE
    )
    assert turned == pytest.approx(15)  # looking down, its right side goes to the south first


def test_footprint_with_the_horizon_is_refused() -> None:
    pose = Pose(x_m=0, y_m=0, altitude_m=50, heading_deg=0, pitch_deg=-20, fov_deg=60)
    with pytest.raises(HorizonInView, match="expected 3 or more"):
        footprint(pose, (480, 480))
    with pytest.raises(HorizonInView, match="no ground"):
        looked_at(Pose(x_m=0, y_m=0, altitude_m=5, heading_deg=0, pitch_deg=2, fov_deg=60))


def test_ground_equals_the_rays_of_the_simulator() -> None:
    scene = prepare_scene(make_town(np.random.default_rng(0), frame_pixels=32), Day())
    pose = Pose(x_m=12, y_m=-7, altitude_m=90, heading_deg=211, pitch_deg=-55, fov_deg=48)
    size = 16
    n = size * RAYS_PER_PIXEL
    col_a, _, row_a, _ = _rays(scene, pose, n, slice(0, n))
    east_NN = (col_a - scene.origin) * scene.metres_per_pixel
    north_NN = (scene.origin - row_a) * scene.metres_per_pixel
    at_N = (np.arange(n) + 0.5) / RAYS_PER_PIXEL
    pixels_M2 = np.stack([a.ravel() for a in np.meshgrid(at_N, at_N)], axis=1)
    ground_M2 = apply_homography(photo_to_ground(pose, (size, size)), pixels_M2)
    np.testing.assert_allclose(ground_M2[:, 0], east_NN.ravel(), atol=5e-3)
    np.testing.assert_allclose(ground_M2[:, 1], north_NN.ravel(), atol=5e-3)
