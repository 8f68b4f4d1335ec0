"""Pixels by a homography, and the homography of a north-up picture of the ground.

Pixels are counted from the outer corner of the first one, as in `ground.py`; OpenCV counts from its
middle.
"""

import cv2
import numpy as np

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


def warp(
    image_HW3: Pixels,
    homography_33: Doubles,
    size: tuple[int, int],
    beyond: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> Pixels:
    """The picture of `size` (width, height) that a homography makes of an image; beyond the image
    this colour."""
    warped_HW3 = cv2.warpPerspective(
        image_HW3, np.linalg.inv(FROM_MIDDLE_33) @ homography_33 @ FROM_MIDDLE_33, size,
        flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=beyond,
    )  # fmt: skip
    return np.asarray(warped_HW3, np.uint8)
