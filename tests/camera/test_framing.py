"""Photos framed like tiles: by the pose, by the heading, or at several scales."""

import numpy as np
import pytest

from pipeline.camera.framing import (
    FRAME_PX,
    SCALES,
    frame_photo,
    level_range,
    nearest_side,
    tile_levels,
    views_of_photo,
)
from pipeline.camera.pose import PartialPose
from pipeline.core.arrays import Pixels

POSE = PartialPose(heading_deg=90.0, pitch_deg=-90.0, height_m=50.0, fov_deg=90.0)


def quarters() -> Pixels:
    """A square photo: its upper left quarter is white."""
    photo_HW3 = np.zeros((200, 200, 3), np.uint8)
    photo_HW3[:100, :100] = 255
    return photo_HW3


def test_frame_by_the_pose_is_north_up() -> None:
    # It looks east: its upper left is the north-east of the 100 m that it shows.
    framed, how = frame_photo(quarters(), POSE, 100.0)
    assert how == "ground"
    middle, edge = FRAME_PX // 4, 3 * FRAME_PX // 4
    assert [int(framed[y, x, 0]) for y in (middle, edge) for x in (middle, edge)] == [0, 255, 0, 0]


def test_frame_of_a_larger_tile_is_filled_with_the_mean() -> None:
    framed, _ = frame_photo(quarters(), POSE, 200.0)
    assert int(framed[2, 2, 0]) == pytest.approx(64, abs=2)


def test_frame_by_the_heading_alone_turns() -> None:
    framed, how = frame_photo(quarters(), PartialPose(heading_deg=180.0), 100.0)
    assert how == "north"
    assert framed[3 * FRAME_PX // 4, 3 * FRAME_PX // 4, 0] == 255


def test_views_of_an_unknown_camera_have_several_scales() -> None:
    views = views_of_photo(quarters(), PartialPose(), [50.0, 100.0])
    assert (views.framing, views.level) == ("none", None)
    assert [len(image) for image in views.images] == [round(200 * share) for share in SCALES]


def test_views_of_a_known_camera_are_of_the_nearest_level() -> None:
    views = views_of_photo(quarters(), POSE, [60.0, 90.0, 240.0])
    assert (len(views.images), views.framing) == (1, "ground")
    assert views.level == pytest.approx((np.sqrt(60 * 90), np.sqrt(90 * 240)))
    assert views_of_photo(quarters(), POSE, [100.0]).level is None


def test_tile_levels_are_runs_of_like_sides() -> None:
    sides_N = np.array([240.0, 60.0, np.nan, 61.0, 120.0, 60.5])
    assert tile_levels(sides_N) == [60.5, 120.0, 240.0]
    assert tile_levels(np.array([np.nan])) == []
    assert level_range(1000.0, [60.0]) == (0.0, np.inf)


def test_nearest_side_is_the_largest_that_fits_the_photo() -> None:
    assert nearest_side(POSE, (200, 200), [60.0, 90.0, 240.0]) == 90.0
    assert nearest_side(PartialPose(), (200, 200), [60.0, 90.0]) == 60.0
    assert nearest_side(POSE, (200, 200), [120.0]) == 120.0
    assert nearest_side(POSE, (200, 200), []) is None
