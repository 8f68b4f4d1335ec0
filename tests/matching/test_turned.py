"""Pairs of points that are turned alike are fitted together."""

import numpy as np
import pytest

from pipeline.camera.ground import apply_homography, ground_to_photo, heading_of
from pipeline.core.arrays import Doubles, Floats
from pipeline.matching.ground_fit import fit_ground, fit_turned, turned_alike
from tests.matching.made_maps import POSE, SIZE

TOLERANCE_M = 1.0
RIGHT, WRONG = 26, 400
"Pairs: too few right ones to be found among all."


@pytest.fixture
def pairs() -> tuple[Doubles, Doubles, Floats]:
    """Pixels, ground and turns: the right ones first."""
    rng = np.random.default_rng(5)
    photo_M2 = rng.uniform(0, SIZE, (RIGHT + WRONG, 2))
    to_ground_33 = np.asarray(np.linalg.inv(ground_to_photo(POSE, SIZE)))
    ground_M2 = apply_homography(to_ground_33, photo_M2)
    ground_M2[RIGHT:] = rng.uniform(-60, 60, (WRONG, 2))
    turn_M = rng.uniform(-360, 360, RIGHT + WRONG).astype(np.float32)
    turn_M[:RIGHT] = POSE.heading_deg + rng.normal(0, 10, RIGHT)
    return photo_M2, ground_M2, turn_M


@pytest.mark.parametrize("heading_deg", [None, POSE.heading_deg + 15])
def test_fit_turned_finds_few_right_pairs(
    pairs: tuple[Doubles, Doubles, Floats], heading_deg: float | None
) -> None:
    photo_M2, ground_M2, turn_M = pairs
    alone = fit_ground(photo_M2, ground_M2, SIZE, TOLERANCE_M)
    assert alone is None or not alone.inliers_M[:RIGHT].all()
    found = fit_turned(photo_M2, ground_M2, turn_M, heading_deg, SIZE, TOLERANCE_M)
    assert found is not None
    assert found.inliers_M[:RIGHT].all()
    assert heading_of(found.to_ground_33, SIZE) == pytest.approx(POSE.heading_deg, abs=2)


def test_fit_turned_of_another_heading_does_not_find_them(
    pairs: tuple[Doubles, Doubles, Floats],
) -> None:
    found = fit_turned(*pairs, POSE.heading_deg + 180, SIZE, TOLERANCE_M)
    assert found is None or not found.inliers_M[:RIGHT].all()


def test_turned_alike_wraps_around() -> None:
    turn_M = np.array([-350, 10, 370, 55, -40, 180], np.float32)
    assert turned_alike(turn_M, 350.0).tolist() == [True, True, True, False, True, False]
