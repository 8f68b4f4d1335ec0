"""Heights of the ground below a window of the map: roofs and trees lie elsewhere in an oblique
photo than on a map that was taken from straight above.

In: pairs of points, the homography that most of them agree with, and heights. Out: a homography
that agrees with more. A camera at a known place sees a point of the relief in line with another one
at the level of the ground in the photo's middle; with these in place of the map's, one homography
holds for roofs and streets alike, and the photo's middle is where its ray meets the relief.
Shapes: M pairs, N points, H, W pixels, 33 = a homography; ground is (east, north) in metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.camera.ground import apply_homography, camera_above
from pipeline.core.arrays import Doubles, Floats
from pipeline.matching.ground_fit import GroundFit, fit_ground, is_camera_view

CAMERA_ROUNDS = 3
"A better homography tells the camera's place better."
LENSES_DEG = (40.0, 55.0, 70.0)
"""Fields of view across a photo that are tried where its own is not known: five or thirteen of them
place no more photos (60 over a town, a trial)."""
MOST_SHIFT_M = 30.0
"Of a pair from the first homography: a roof of 20 m at the border of an oblique photo."
CLEARANCE_M = 5.0
"Of a camera above the highest point of the relief: lower, it is no UAV's."
NEARLY = 0.9
"As many inliers, as a share of the flat ground's, do for the relief: it is the truer one."


@dataclass(frozen=True, kw_only=True)
class Relief:
    """Heights in a north-up square around a window's zero."""

    height_HW: Floats
    "Metres; the first row is the northern one."
    metres_per_pixel: float

    def at(self, ground_N2: Doubles) -> Doubles:
        """The heights (N,) of points, those of the border beyond it."""
        rows, columns = self.height_HW.shape
        column_N = ground_N2[:, 0] / self.metres_per_pixel + columns / 2
        row_N = rows / 2 - ground_N2[:, 1] / self.metres_per_pixel
        row_N = np.clip(row_N, 0, rows - 1).astype(np.int64)
        column_N = np.clip(column_N, 0, columns - 1).astype(np.int64)
        return np.asarray(self.height_HW[row_N, column_N], np.float64)


def fit_relief(
    photo_M2: Doubles,
    ground_M2: Doubles,
    relief: Relief,
    flat: GroundFit,
    size: tuple[int, int],
    fov_deg: float | None,
    tolerance_m: float,
) -> GroundFit:
    """The homography to the level of the ground in the photo's middle that most pairs agree with,
    their ground seen in line with it; `flat`, the one without heights, where none agrees with
    nearly as many.

    `fov_deg`: across a photo of `size` (width, height); None where it is not known.
    """
    if not is_camera_view(flat.to_ground_33, size):
        return flat
    apart_M = np.linalg.norm(apply_homography(flat.to_ground_33, photo_M2) - ground_M2, axis=1)
    near = np.flatnonzero(apart_M < MOST_SHIFT_M)
    height_M = relief.at(ground_M2)
    pairs = _Pairs(
        photo_M2=photo_M2[near],
        ground_M2=ground_M2[near],
        height_M=height_M[near],
        size=size,
        tolerance_m=tolerance_m,
    )
    level_m = float(np.median(height_M[flat.inliers_M]))
    lenses: Sequence[float] = LENSES_DEG if fov_deg is None else (fov_deg,)
    found = [_fit_with_lens(pairs, relief, flat, level_m, lens) for lens in lenses]
    best = max((one for one in found if one), key=lambda one: one.inliers, default=None)
    if best is None or best.inliers < NEARLY * flat.inliers:
        return flat
    return best.among(near, len(photo_M2))


@dataclass(frozen=True, kw_only=True)
class _Pairs:
    """Pairs that can be right, and the heights of their ground."""

    photo_M2: Doubles
    ground_M2: Doubles
    height_M: Doubles
    size: tuple[int, int]
    tolerance_m: float


def _fit_with_lens(
    pairs: _Pairs, relief: Relief, fit: GroundFit, level_m: float, fov_deg: float
) -> GroundFit | None:
    """The fit after CAMERA_ROUNDS of camera and homography in turn, from one to `level_m`; None
    where a camera is not above the relief, or no view that a camera can have holds."""
    highest_m = float(pairs.height_M.max())
    for _ in range(CAMERA_ROUNDS):
        east, north, up = camera_above(fit.to_ground_33, pairs.size, fov_deg)
        camera_3 = np.array([east, north, level_m + up])
        level_m = _height_of_middle(relief, fit, camera_3, level_m, pairs.size)
        if camera_3[2] < max(highest_m, level_m) + CLEARANCE_M:
            return None
        seen_M2 = in_line(pairs.ground_M2, pairs.height_M, camera_3, level_m)
        found = fit_ground(pairs.photo_M2, seen_M2, pairs.size, pairs.tolerance_m)
        if found is None or not is_camera_view(found.to_ground_33, pairs.size):
            return None
        fit = found
    return fit


def in_line(ground_N2: Doubles, height_N: Doubles, camera_3: Doubles, level_m: float) -> Doubles:
    """Where rays from a camera (east, north, height) through points of the relief meet a level (N,
    2); the points are below the camera."""
    share_N1 = ((camera_3[2] - level_m) / (camera_3[2] - height_N))[:, None]
    return np.asarray(camera_3[:2] + (ground_N2 - camera_3[:2]) * share_N1)


def _height_of_middle(
    relief: Relief, fit: GroundFit, camera_3: Doubles, level_m: float, size: tuple[int, int]
) -> float:
    """The height at which the ray of the photo's middle meets the relief first."""
    [middle_2] = apply_homography(fit.to_ground_33, np.array([[size[0] / 2, size[1] / 2]]))
    toward_3 = np.array([*middle_2, level_m]) - camera_3
    low_m = float(relief.height_HW.min())
    deepest = (camera_3[2] - low_m) / (camera_3[2] - level_m)
    steps = max(2, int(np.linalg.norm(toward_3) * deepest / relief.metres_per_pixel))
    ray_N3 = camera_3 + np.linspace(0, deepest, steps)[:, None] * toward_3
    below_N = ray_N3[:, 2] <= relief.at(ray_N3[:, :2])
    return float(ray_N3[np.argmax(below_N), 2]) if below_N.any() else low_m
