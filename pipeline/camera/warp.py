"""Pixels by a homography, and the homography of a north-up picture of the ground.

Pixels are counted from the outer corner of the first one, as in `ground.py`; OpenCV counts from its
middle.
"""

import cv2
import numpy as np

from pipeline.camera.ground import corners
from pipeline.core.arrays import Doubles, Pixels

FROM_MIDDLE_33 = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
ENOUGH_PIXELS = 0.75
"Pixels of a picture for one of its source: below it a warp alone would alias."


def north_up(pixels_per_metre: float, west_m: float, north_m: float) -> Doubles:
    """The homography (33) from the ground, (east, north) in metres, to a picture whose upper left
    corner lies at (west_m, north_m)."""
    scale = pixels_per_metre
    return np.array([[scale, 0, -scale * west_m], [0, -scale, scale * north_m], [0, 0, 1]])


def shrink_first(image_HW3: Pixels, shrink: float) -> tuple[Pixels, Doubles]:
    """The image averaged to `shrink` times its size where that is well below 1, and the homography
    (33) from its pixels to those of the image given."""
    if shrink >= ENOUGH_PIXELS:
        return image_HW3, np.eye(3)
    height, width = image_HW3.shape[:2]
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    smaller_HW3 = np.asarray(cv2.resize(image_HW3, size, interpolation=cv2.INTER_AREA), np.uint8)
    return smaller_HW3, np.diag([width / size[0], height / size[1], 1.0])


def lay_on(image_HW3: Pixels, target_42: Doubles, size: tuple[int, int]) -> Pixels:
    """A picture (H, W, 4) of `size` (width, height) with an image whose corners, from the upper
    left clockwise, lie at `target_42`; transparent beyond it."""
    sides_4 = np.linalg.norm(np.roll(target_42, -1, axis=0) - target_42, axis=1)
    image_HW3, _ = shrink_first(image_HW3, float(sides_4.max()) / max(image_HW3.shape[:2]))
    height, width = image_HW3.shape[:2]
    source_42 = corners((width, height)).astype(np.float32)
    homography_33 = cv2.getPerspectiveTransform(source_42, target_42.astype(np.float32))
    opaque_HW4 = np.dstack([image_HW3, np.full((height, width), 255, np.uint8)])
    return warp(opaque_HW4, np.asarray(homography_33, np.float64), size, (0.0, 0.0, 0.0, 0.0))


def warp(
    image_HWC: Pixels,
    homography_33: Doubles,
    size: tuple[int, int],
    beyond: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> Pixels:
    """The picture of `size` (width, height) that a homography makes of an image; beyond the image
    this colour."""
    warped_HWC = cv2.warpPerspective(
        image_HWC, np.linalg.inv(FROM_MIDDLE_33) @ homography_33 @ FROM_MIDDLE_33, size,
        flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=beyond,
    )  # fmt: skip
    return np.asarray(warped_HWC, np.uint8)
