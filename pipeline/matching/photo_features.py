"""A photo's features, found once for all windows: on the photo as it lies on the ground, where its
pose is known.

In: pixels, and what is known of the camera. Out: a `MatchablePhoto`, of SIFT's features or of dense
ones.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from pipeline.camera.ground import (
    HorizonInView,
    apply_homography,
    corners,
    footprint,
    photo_to_ground,
)
from pipeline.camera.pose import PartialPose
from pipeline.camera.warp import north_up, warp
from pipeline.core.arrays import Doubles, Pixels
from pipeline.matching.local_features import DenseFinder, LocalFeatures, find_features

PHOTO_PX = 640
"Longest side of a photo when it is matched."
PHOTO_FEATURES = 2000
DENSE_PHOTO_STEP_PX = 8
"Between its dense features."


@dataclass(frozen=True, kw_only=True)
class MatchablePhoto:
    """A photo with its features, found once for all windows."""

    pixels_HW3: Pixels
    "As it is matched."
    features: LocalFeatures
    pose: PartialPose
    promised_33: Doubles | None
    """The homography to the ground, (east, north) in metres from below the camera, that its pose
    promises; None where that is not complete, or shows the horizon."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height when matched."""
        return self.pixels_HW3.shape[1], self.pixels_HW3.shape[0]

    @property
    def reach_m(self) -> float:
        """Half the extent of the ground that the pose promises, metres; 0 where it promises
        none."""
        if self.promised_33 is None:
            return 0.0
        return float(ground_extent(self.promised_33, self.size).max() / 2)


def prepare_photo(photo_HW3: Pixels, pose: PartialPose | None = None) -> MatchablePhoto:
    """The features of a photo; a large one is made smaller first."""
    rows, columns = photo_HW3.shape[:2]
    scale = min(1.0, PHOTO_PX / max(rows, columns))
    size = (round(columns * scale), round(rows * scale))
    small_HW3 = np.asarray(cv2.resize(photo_HW3, size, interpolation=cv2.INTER_AREA), np.uint8)
    pose = pose or PartialPose()
    promised_33 = promised_ground(pose, size)
    if promised_33 is None:
        features = find_features(small_HW3, PHOTO_FEATURES)
    else:
        pixels_per_metre = PHOTO_PX / float(ground_extent(promised_33, size).max())
        features = _features_on_the_ground(small_HW3, promised_33, pixels_per_metre, _find_sift)
    return MatchablePhoto(
        pixels_HW3=small_HW3, features=features, pose=pose, promised_33=promised_33
    )


def with_dense_features(
    photo: MatchablePhoto, find: DenseFinder, metres_per_pixel: float
) -> MatchablePhoto:
    """The photo with dense features of the ground that its pose promises, at a map's scale. Raises
    ValueError where it promises none: dense features know no turn and no scale."""
    if photo.promised_33 is None:
        raise ValueError("the photo's pose promises no ground, expected a complete one")

    def find_dense(flat_HW3: Pixels, mask_HW: Pixels) -> LocalFeatures:
        return find(flat_HW3, DENSE_PHOTO_STEP_PX, mask_HW)

    return replace(
        photo,
        features=_features_on_the_ground(
            photo.pixels_HW3, photo.promised_33, 1 / metres_per_pixel, find_dense
        ),
    )


def ground_extent(to_ground_33: Doubles, size: tuple[int, int]) -> Doubles:
    """How far east and north (2,) the ground of a photo of `size` (width, height) extends."""
    return np.asarray(np.ptp(apply_homography(to_ground_33, corners(size)), axis=0))


def promised_ground(pose: PartialPose, size: tuple[int, int]) -> Doubles | None:
    """The homography to the ground by the pose; None where it is not complete, or shows the
    horizon."""
    if not pose.complete:
        return None
    try:
        footprint(pose.over(), size)
    except HorizonInView:
        return None
    return photo_to_ground(pose.over(), size)


def _find_sift(flat_HW3: Pixels, mask_HW: Pixels) -> LocalFeatures:
    return find_features(flat_HW3, PHOTO_FEATURES, mask_HW)


def _features_on_the_ground(
    photo_HW3: Pixels,
    to_ground_33: Doubles,
    pixels_per_metre: float,
    find: Callable[[Pixels, Pixels], LocalFeatures],
) -> LocalFeatures:
    """Features, in the photo's own pixels, that are found on the photo as it lies on the ground:
    north up, an oblique view no longer foreshortened."""
    size = (photo_HW3.shape[1], photo_HW3.shape[0])
    to_flat_33, flat_size = flat_frame(to_ground_33, size, pixels_per_metre)
    flat_HW3 = warp(photo_HW3, to_flat_33, flat_size)
    mask_HW = np.zeros(flat_size[::-1], np.uint8)
    outline_42 = apply_homography(to_flat_33, corners(size))
    cv2.fillConvexPoly(mask_HW, np.round(outline_42).astype(np.int32), 255)
    found = find(flat_HW3, mask_HW)
    return LocalFeatures(
        points_N2=apply_homography(np.asarray(np.linalg.inv(to_flat_33)), found.points_N2),
        descriptors_ND=found.descriptors_ND,
        angles_N=found.angles_N,
    )


def flat_frame(
    to_ground_33: Doubles, size: tuple[int, int], pixels_per_metre: float
) -> tuple[Doubles, tuple[int, int]]:
    """The homography from the pixels of a photo of `size` (width, height) to a north-up picture of
    its ground, and the picture's size."""
    ground_42 = apply_homography(to_ground_33, corners(size))
    least_2, most_2 = ground_42.min(axis=0), ground_42.max(axis=0)
    width, height = (
        max(1, round(side)) for side in ((most_2 - least_2) * pixels_per_metre).tolist()
    )
    place_33 = north_up(pixels_per_metre, float(least_2[0]), float(most_2[1]))
    return place_33 @ to_ground_33, (width, height)
