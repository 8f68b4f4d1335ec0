"""Pairs of points -> the homography from a photo to the ground, how well it holds, and whether a
camera above the ground can make it.

In: pixels of a photo and their ground in metres. Out: a `GroundFit`. The robust estimate is
OpenCV's RANSAC, which draws by a seed of its own. In OpenCV 5.0 its USAC methods often end too
early (docs/decisions.md).
Shapes: M pairs, K inliers, 33 = a homography.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from pipeline.camera.ground import apply_homography, corners
from pipeline.core.arrays import Doubles, Floats, Ints, Mask

LEAST_PAIRS = 8
"Four determine a homography; twice as many can contradict each other."
MAX_ITERATIONS = 10_000
"Where one pair in eight is right, they find it with a probability of 0.9; some 0.2 s."
CONFIDENCE = 0.9999
HEADINGS_DEG, ALIKE_DEG = tuple(range(0, 360, 40)), 40.0
"""Headings that are tried, and how far from one a pair may be turned: an image 45 degrees below the
horizon turns what lies across it by 10, and its sides by 20."""
ITERATIONS_A_HEADING = 500
"""Where one of such pairs in four is right, they find it with a probability of 0.9. Six times as
many found no more (60 photos over a town on another day, a trial)."""
NEAR_TOLERANCES = 10.0
"Pairs so near to the best of these fits are fitted once more, however they are turned."
PROMISED_SHARE = 0.05
"""By which a promised point may err beyond a shift, turn and scale of all, as a share of the ground
that the photo shows: a pitch wrong by two degrees, 45 degrees below the horizon."""
LONGEST_SIDE_RATIO = 6.0
"Of a footprint's sides: an image 35 degrees below the horizon by a wide lens has 5."
FLATTEST_WEIGHT = 0.15
"Of the third coordinate at one corner to that at another: less is the horizon."


@dataclass(frozen=True, kw_only=True)
class GroundFit:
    """A homography from a photo's pixels to the ground, (east, north) in metres."""

    to_ground_33: Doubles
    inliers_M: Mask
    "Which pairs agree with it."
    residual_m: float
    "Root mean square distance of the inliers on the ground, metres."
    middle_covariance_22: Doubles
    "Of the photo's middle on the ground, (east, north), square metres, by the inliers' spread."

    @property
    def inliers(self) -> int:
        return int(self.inliers_M.sum())

    def among(self, numbers: Ints, pairs: int) -> "GroundFit":
        """The fit of some pairs, by their numbers, as one of all `pairs`."""
        inliers_M = np.zeros(pairs, np.bool_)
        inliers_M[numbers[self.inliers_M]] = True
        return replace(self, inliers_M=inliers_M)


def fit_ground(
    photo_M2: Doubles,
    ground_M2: Doubles,
    size: tuple[int, int],
    tolerance_m: float,
    iterations: int = MAX_ITERATIONS,
) -> GroundFit | None:
    """The homography that most pairs agree with to `tolerance_m`; None where none is found.

    `photo_M2`: pixels of a photo of `size` (width, height); `ground_M2`: their (east, north).
    """
    if len(photo_M2) < LEAST_PAIRS:
        return None
    homography_33, found_M = cv2.findHomography(
        photo_M2, ground_M2, cv2.RANSAC, tolerance_m, maxIters=iterations, confidence=CONFIDENCE
    )
    if homography_33 is None or not np.isfinite(homography_33).all():
        return None
    inliers_M = found_M.ravel() > 0
    if inliers_M.sum() < LEAST_PAIRS:
        return None
    to_ground_33 = np.asarray(homography_33, np.float64)
    apart_K2 = apply_homography(to_ground_33, photo_M2[inliers_M]) - ground_M2[inliers_M]
    return GroundFit(
        to_ground_33=to_ground_33,
        inliers_M=inliers_M,
        residual_m=float(np.sqrt((apart_K2**2).sum(axis=1).mean())),
        middle_covariance_22=_middle_covariance(to_ground_33, photo_M2[inliers_M], apart_K2, size),
    )


def fit_turned(
    photo_M2: Doubles,
    ground_M2: Doubles,
    turn_M: Floats,
    heading_deg: float | None,
    size: tuple[int, int],
    tolerance_m: float,
) -> GroundFit | None:
    """`fit_ground` of a photo whose pose is not known: among the pairs that are turned alike, for
    one heading after the other or for `heading_deg` alone, as every other pair is wrong; then
    among all that are near the best. None where no view that a camera can have holds.

    `turn_M`: degrees by which a pair's point is turned further on the map than in the photo: the
    heading, where the pair is right and the camera looks down.
    """
    headings = HEADINGS_DEG if heading_deg is None else (heading_deg,)
    best: GroundFit | None = None
    for heading in headings:
        alike = np.flatnonzero(turned_alike(turn_M, heading))
        fit = fit_ground(photo_M2[alike], ground_M2[alike], size, tolerance_m, ITERATIONS_A_HEADING)
        if fit is None or not is_camera_view(fit.to_ground_33, size):
            continue
        if best is None or fit.inliers > best.inliers:
            best = fit.among(alike, len(turn_M))
    if best is None:
        return None
    apart_M = np.linalg.norm(apply_homography(best.to_ground_33, photo_M2) - ground_M2, axis=1)
    near = np.flatnonzero(apart_M < NEAR_TOLERANCES * tolerance_m)
    again = fit_ground(photo_M2[near], ground_M2[near], size, tolerance_m)
    if again is None or again.inliers < best.inliers:
        return best
    return again.among(near, len(turn_M))


def turned_alike(turn_M: Floats, heading_deg: float) -> Mask:
    """Which pairs (M,) are turned as in a photo of this heading, roughly."""
    return np.asarray(np.abs((turn_M - heading_deg + 180) % 360 - 180) <= ALIKE_DEG)


def agree_with_promise(promised_M2: Doubles, ground_M2: Doubles) -> Mask:
    """Which pairs (M,) one shift, turn and scale brings together, roughly, where a pose promises
    the ground of the photo's points: two pairs determine it, so that one right one in fifty is
    enough."""
    if len(promised_M2) < LEAST_PAIRS:
        return np.zeros(len(promised_M2), np.bool_)
    tolerance_m = PROMISED_SHARE * float(np.ptp(promised_M2, axis=0).max())
    _, found_M = cv2.estimateAffinePartial2D(
        promised_M2, ground_M2, method=cv2.RANSAC, ransacReprojThreshold=tolerance_m,
        maxIters=MAX_ITERATIONS, confidence=CONFIDENCE,
    )  # fmt: skip
    return np.zeros(len(promised_M2), np.bool_) if found_M is None else found_M.ravel() > 0


def is_camera_view(to_ground_33: Doubles, size: tuple[int, int]) -> bool:
    """Whether a camera above the ground can see the photo so: not mirrored, without the horizon,
    and with a convex footprint of moderate sides."""
    corners_42 = corners(size)
    weight_4 = np.c_[corners_42, np.ones(4)] @ to_ground_33[2]
    if weight_4.min() <= 0 <= weight_4.max():  # the horizon crosses the photo
        return False
    if np.abs(weight_4).min() < FLATTEST_WEIGHT * np.abs(weight_4).max():
        return False
    ground_42 = apply_homography(to_ground_33, corners_42)
    side_42 = np.roll(ground_42, -1, axis=0) - ground_42
    next_42 = np.roll(side_42, -1, axis=0)
    turn_4 = side_42[:, 0] * next_42[:, 1] - side_42[:, 1] * next_42[:, 0]
    length_4 = np.linalg.norm(side_42, axis=1)
    # Rows count downwards and north is up: from above, the corners go round clockwise.
    return bool((turn_4 < 0).all() and length_4.max() < LONGEST_SIDE_RATIO * length_4.min())


def _middle_covariance(
    to_ground_33: Doubles, photo_K2: Doubles, apart_K2: Doubles, size: tuple[int, int]
) -> Doubles:
    """First order propagation of the inliers' residuals to the photo's middle.

    Pixels are counted from the middle, in half widths, and the last number of the homography is 1:
    the middle's ground is then the third and the sixth of the other eight, and their covariance is
    that of the least squares estimate. [Hartley and Zisserman, section 5.2]
    """
    half = size[0] / 2
    from_middle_33 = np.array([[half, 0, half], [0, half, size[1] / 2], [0, 0, 1]])
    centred_33 = to_ground_33 @ from_middle_33
    centred_33 /= centred_33[2, 2]
    points_K3 = np.c_[photo_K2 - (half, size[1] / 2), np.full(len(photo_K2), half)] / half
    mapped_K3 = points_K3 @ centred_33.T
    scaled_K3 = points_K3 / mapped_K3[:, 2:]
    ground_K2 = mapped_K3[:, :2] / mapped_K3[:, 2:]
    zero_K3 = np.zeros_like(scaled_K3)
    east_K8 = np.hstack([scaled_K3, zero_K3, -ground_K2[:, :1] * scaled_K3[:, :2]])
    north_K8 = np.hstack([zero_K3, scaled_K3, -ground_K2[:, 1:] * scaled_K3[:, :2]])
    slope_L8 = np.concatenate([east_K8, north_K8])
    variance = float((apart_K2**2).sum() / max(len(slope_L8) - 8, 1))
    try:
        covariance_88 = variance * np.linalg.inv(slope_L8.T @ slope_L8)
    except np.linalg.LinAlgError:  # points on a line
        return np.diag([np.inf, np.inf])
    return np.asarray(covariance_88[np.ix_([2, 5], [2, 5])])
