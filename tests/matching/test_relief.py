"""Roofs in oblique photos: one homography holds for them and for the streets."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from pipeline.camera.ground import apply_homography, camera_axes, focal_length_px
from pipeline.camera.pose import Pose
from pipeline.core.arrays import Doubles
from pipeline.matching.ground_fit import GroundFit, fit_ground
from pipeline.matching.relief import Relief, fit_relief, in_line

SIZE, TOLERANCE_M = (640, 480), 1.0
MIDDLE = np.array([[SIZE[0] / 2, SIZE[1] / 2]])


@pytest.fixture(scope="module")
def relief() -> Relief:
    """Ground at 300 m above the sea, and on it blocks of 6 to 18 m."""
    rng = np.random.default_rng(4)
    height_HW = np.full((400, 400), 300.0, np.float32)
    for x, y in rng.integers(20, 360, (40, 2)):
        height_HW[y : y + 30, x : x + 30] = 300 + rng.uniform(6, 18)
    height_HW[190:215, 190:215] = 315  # below the photo's middle
    return Relief(height_HW=height_HW, metres_per_pixel=0.5)


def project(pose: Pose, ground_N2: Doubles, height_N: Doubles) -> Doubles:
    """Pixels (N, 2) of points of the relief, seen from a camera above level 300."""
    from_camera_N3 = np.c_[ground_N2 - (pose.x_m, pose.y_m), height_N - 300 - pose.altitude_m]
    seen_N3 = from_camera_N3 @ camera_axes(pose)
    focal = focal_length_px(pose.fov_deg, SIZE[0])
    return np.asarray(focal * seen_N3[:, :2] / seen_N3[:, 2:] + MIDDLE)


Pairs = tuple[Doubles, Doubles]


@pytest.fixture
def make_pairs(relief: Relief) -> Callable[[Pose], Pairs]:
    """Pixels and the map's points (M, 2): 400 right ones to a third of a pixel, 200 of chance."""

    def make(pose: Pose) -> Pairs:
        rng = np.random.default_rng(1)
        ground_N2 = rng.uniform(-90, 90, (4000, 2))
        photo_N2 = project(pose, ground_N2, relief.at(ground_N2))
        shown_N = ((photo_N2 > 0) & (photo_N2 < SIZE)).all(axis=1)
        photo_M2, ground_M2 = photo_N2[shown_N][:400], ground_N2[shown_N][:400]
        photo_M2 = photo_M2 + rng.normal(0, 0.3, photo_M2.shape)
        chance_M2 = rng.uniform(0, SIZE, (200, 2))
        return (
            np.concatenate([photo_M2, chance_M2]),
            np.concatenate([ground_M2, rng.uniform(-90, 90, (200, 2))]),
        )

    return make


def oblique(heading_deg: float = 30.0) -> Pose:
    """A camera 80 m above the ground that looks at a roof of 15 m at (1, -1)."""
    away_m = (80 - 15) / np.tan(np.radians(50))
    turn = np.radians(heading_deg)
    return Pose(
        x_m=1 - away_m * np.sin(turn), y_m=-1 - away_m * np.cos(turn), altitude_m=80,
        heading_deg=heading_deg, pitch_deg=-50, fov_deg=60,
    )  # fmt: skip


def fitted(pairs: Pairs, relief: Relief, fov_deg: float | None) -> tuple[GroundFit, GroundFit]:
    flat = fit_ground(*pairs, SIZE, TOLERANCE_M)
    assert flat is not None
    return flat, fit_relief(*pairs, relief, flat, SIZE, fov_deg, TOLERANCE_M)


@pytest.mark.parametrize("fov_deg", [60.0, None])
def test_fit_relief_places_the_middle_on_its_roof(
    relief: Relief, make_pairs: Callable[[Pose], Pairs], fov_deg: float | None
) -> None:
    flat, found = fitted(make_pairs(oblique()), relief, fov_deg)
    assert found.inliers > (385 if fov_deg else 1.05 * flat.inliers)
    [before], [after] = (apply_homography(one.to_ground_33, MIDDLE) for one in (flat, found))
    assert np.hypot(*(before - (1, -1))) > 8
    assert np.hypot(*(after - (1, -1))) < (0.3 if fov_deg else 4.0)


def test_fit_relief_over_flat_ground_is_the_flat_fit(
    make_pairs: Callable[[Pose], Pairs], relief: Relief
) -> None:
    rng = np.random.default_rng(2)
    pose, ground_M2 = oblique(200.0), rng.uniform(-40, 40, (300, 2))
    level = Relief(height_HW=np.full((400, 400), 300, np.float32), metres_per_pixel=0.5)
    photo_M2 = project(pose, ground_M2, level.at(ground_M2))
    flat, found = fitted((photo_M2, ground_M2), level, 60.0)
    assert found.inliers == flat.inliers
    assert found.to_ground_33 / found.to_ground_33[2, 2] == pytest.approx(
        flat.to_ground_33 / flat.to_ground_33[2, 2], abs=1e-4
    )


def test_fit_relief_of_a_camera_within_it_is_the_flat_fit(
    relief: Relief, make_pairs: Callable[[Pose], Pairs]
) -> None:
    """Heights in another unit, or of another place."""
    wrong = Relief(height_HW=(relief.height_HW - 300) * 20, metres_per_pixel=0.5)
    flat, found = fitted(make_pairs(oblique()), wrong, 60.0)
    assert found is flat


def test_fit_relief_below_a_tower_at_the_camera_is_the_flat_fit(
    relief: Relief, make_pairs: Callable[[Pose], Pairs]
) -> None:
    """The ray of the middle begins within it; no pair lies on it."""
    pose, height_HW = oblique(), relief.height_HW.copy()
    column, row = 200 + round(pose.x_m / 0.5), 200 - round(pose.y_m / 0.5)
    height_HW[row - 4 : row + 4, column - 4 : column + 4] = 500
    flat, found = fitted(make_pairs(pose), replace(relief, height_HW=height_HW), 60.0)
    assert found is flat


def test_in_line_moves_roofs_away_from_the_camera() -> None:
    camera_3, ground_N2 = np.array([0.0, 0.0, 100.0]), np.array([[50.0, 0.0], [50.0, 0.0]])
    seen_N2 = in_line(ground_N2, np.array([0.0, 20.0]), camera_3, 0.0)
    assert seen_N2 == pytest.approx(np.array([[50.0, 0.0], [62.5, 0.0]]))


def test_relief_at_reads_the_north_first() -> None:
    relief = Relief(height_HW=np.array([[1, 2], [3, 4]], np.float32), metres_per_pixel=10.0)
    places_N2 = np.array([[-5.0, 5.0], [5.0, 5.0], [-5.0, -5.0], [500.0, -500.0]])
    assert relief.at(places_N2).tolist() == [1, 2, 3, 4]
