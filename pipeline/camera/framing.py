"""A photo as a tile of the map would show it: north up, and as much ground as the tile.

In: pixels, and what is known of the camera. Out: pixels, framed as far as it is known. A complete
pose lays the photo on the ground; a heading alone turns it; without either it stays.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from pipeline.camera.ground import apply_homography, corners, photo_to_ground
from pipeline.camera.pose import PartialPose
from pipeline.camera.warp import north_up, shrink_first, warp
from pipeline.core.arrays import Doubles, Pixels

Framing = Literal["ground", "scale", "north", "none"]
"""How a photo was framed: laid on the ground north up; likewise, as it was turned, without a
heading; only turned north up; or not at all."""
LEVEL_RATIO = 1.1
"Of the sides of two tiles' ground: up to it they are of one level."
FRAME_PX = 384
"Side of a framed photo: encoders take 256 to 384 pixels."
SCALES = (1.0, 0.7, 0.5)
"""Middles of a photo of unknown scale, as shares of its width and height: photos show one to
four tiles' widths (docs/decisions.md, answers)."""


Level = tuple[float, float]
"Least and greatest side of the ground that a level's tiles show, metres."


@dataclass(frozen=True, kw_only=True)
class PhotoViews:
    """The views of a photo by which a gallery is searched."""

    images: list[Pixels]
    framing: Framing = "none"
    level: Level | None = None
    """The gallery's level whose tiles show as much ground as they do; None where theirs is not
    known, or all tiles are of one level."""


def views_of_photo(photo_HW3: Pixels, pose: PartialPose, sides_m: Sequence[float]) -> PhotoViews:
    """The views of a photo by which a gallery whose levels have tiles of these sides, metres,
    rising, is searched: one where the scale is known, else one for each of SCALES."""
    size = (photo_HW3.shape[1], photo_HW3.shape[0])
    side_m = nearest_side(pose, size, sides_m)
    framed_HW3, how = frame_photo(photo_HW3, pose, side_m)
    if side_m is None or how not in ("ground", "scale"):
        return PhotoViews(images=[_middle(framed_HW3, share) for share in SCALES], framing=how)
    level = level_range(side_m, sides_m) if len(sides_m) > 1 else None
    return PhotoViews(images=[framed_HW3], framing=how, level=level)


def tile_levels(sides_N: Doubles) -> list[float]:
    """The levels of tiles by the sides of their ground, in metres, rising: the medians of runs in
    which each is at most LEVEL_RATIO times the one before. NaN is no side."""
    rising_N = np.sort(sides_N[~np.isnan(sides_N)])
    begin = np.flatnonzero(rising_N[1:] > LEVEL_RATIO * rising_N[:-1]) + 1
    return [float(np.median(run)) for run in np.split(rising_N, begin) if len(run)]


def level_range(side_m: float, levels: Sequence[float]) -> Level:
    """Least and greatest side, in metres, of the tiles whose nearest level, as a ratio, is that of
    `side_m`; `levels`: rising, at least one."""
    at = int(np.argmin(np.abs(np.log(np.asarray(levels) / side_m))))
    edges = [0.0, *(float(np.sqrt(a * b)) for a, b in pairwise(levels)), float("inf")]
    return edges[at], edges[at + 1]


def nearest_side(
    pose: PartialPose, size: tuple[int, int], sides_m: Sequence[float]
) -> float | None:
    """Of a gallery's tile sides, in metres, rising: the largest that the ground shown by a photo of
    `size` (width, height) holds, else the smallest; None without any."""
    if not sides_m:
        return None
    if pose.height_m is None or pose.fov_deg is None or pose.pitch_deg is None:
        return sides_m[0]
    slant_m = pose.height_m / np.sin(np.radians(-pose.pitch_deg))
    width_m = 2 * slant_m * np.tan(np.radians(pose.fov_deg) / 2) * min(1.0, size[1] / size[0])
    fitting = [side for side in sides_m if side <= width_m]
    return max(fitting, default=sides_m[0])


def _middle(photo_HW3: Pixels, share: float) -> Pixels:
    """The middle of a photo: this share of its width and of its height."""
    height, width = photo_HW3.shape[:2]
    top, left = round(height * (1 - share) / 2), round(width * (1 - share) / 2)
    return np.ascontiguousarray(photo_HW3[top : height - top, left : width - left])


def frame_photo(
    photo_HW3: Pixels, pose: PartialPose, side_m: float | None
) -> tuple[Pixels, Framing]:
    """The photo framed like a tile of `side_m` metres, and how; (FRAME_PX, FRAME_PX, 3) unless it
    stays as it is. Ground beyond the photo takes the photo's mean colour.

    `side_m` None: the tile's size is not known, and only the heading is used.
    """
    height, width = photo_HW3.shape[:2]
    known = None not in (pose.pitch_deg, pose.height_m, pose.fov_deg)
    if known and side_m is not None:
        upright = replace(pose, heading_deg=pose.heading_deg or 0.0)
        to_ground_33 = photo_to_ground(upright.over(), (width, height))
        if shows_no_sky(to_ground_33, (width, height)):
            framed = lay_on_ground(photo_HW3, to_ground_33, side_m)
            return framed, "scale" if pose.heading_deg is None else "ground"
    if pose.heading_deg is not None:
        return _turned(photo_HW3, pose.heading_deg), "north"
    return photo_HW3, "none"


def shows_no_sky(to_ground_33: Doubles, size: tuple[int, int]) -> bool:
    """Whether all rays of a photo of `size` (width, height) meet the ground, and none far away."""
    weight_4 = np.c_[corners(size), np.ones(4)] @ to_ground_33[2]
    return bool(weight_4.min() > 0.05 * weight_4.max())


def lay_on_ground(photo_HW3: Pixels, to_ground_33: Doubles, side_m: float) -> Pixels:
    """The ground around the photo's middle, a north-up square of `side_m` metres, (FRAME_PX,
    FRAME_PX, 3), by the photo's homography to the ground."""
    height, width = photo_HW3.shape[:2]
    middle_2 = apply_homography(to_ground_33, np.array([[width / 2, height / 2]]))[0]
    half_m = side_m / 2
    place_33 = north_up(FRAME_PX / side_m, middle_2[0] - half_m, middle_2[1] + half_m)
    return _frame(photo_HW3, place_33 @ to_ground_33)


def _turned(photo_HW3: Pixels, heading_deg: float) -> Pixels:
    """The middle square of the photo, turned north up."""
    height, width = photo_HW3.shape[:2]
    scale = FRAME_PX / min(height, width)
    c, s = np.cos(np.radians(heading_deg)) * scale, np.sin(np.radians(heading_deg)) * scale
    turn_33 = np.array([[c, -s, FRAME_PX / 2], [s, c, FRAME_PX / 2], [0, 0, 1]])
    from_middle_33 = np.array([[1, 0, -width / 2], [0, 1, -height / 2], [0, 0, 1]])
    return _frame(photo_HW3, turn_33 @ from_middle_33)


def _frame(photo_HW3: Pixels, to_frame_33: Doubles) -> Pixels:
    """The photo by a homography to the frame; averaged first where it becomes much smaller."""
    height, width = photo_HW3.shape[:2]
    framed_42 = apply_homography(to_frame_33, corners((width, height)))
    shrink = float(np.linalg.norm(framed_42[2] - framed_42[3])) / width
    photo_HW3, to_photo_33 = shrink_first(photo_HW3, shrink)
    mean = tuple(float(value) for value in photo_HW3.reshape(-1, 3).mean(axis=0))
    return warp(photo_HW3, to_frame_33 @ to_photo_33, (FRAME_PX, FRAME_PX), mean)
