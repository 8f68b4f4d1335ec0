"""Points of an image that look alike in another image: SIFT, compared as square roots.

In: images. Out: points with descriptors, and pairs of them. SIFT is OpenCV's [Lowe 2004]; the
descriptors' square roots are compared [RootSIFT, Arandjelovic and Zisserman 2012], and a pair holds
where each is the other's nearest and clearly nearer than the second [Lowe 2004, section 7.1]. Dense
features come from a network, given by the caller; a pair of them holds where each is the other's
nearest.
Shapes: N points, D = 128, M pairs.
"""

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from pipeline.core.arrays import Doubles, Floats, Ints, Pixels

LEAST_CONTRAST = 0.02
"Half of SIFT's own: haze and shadow leave little of a photo's contrast."


@dataclass(frozen=True, kw_only=True)
class LocalFeatures:
    """Points of one image. Dense features know no turn: `angles_N` is None."""

    points_N2: Doubles
    "Column and row, (0, 0) being the outer corner of the first pixel."
    descriptors_ND: Floats
    "Of unit length."
    angles_N: Floats | None = None
    "How each point is turned, degrees clockwise; None where the features know no turn."


class DenseFinder(Protocol):
    """Describes points of an image on a grid, north up, that are told from their neighbours."""

    def __call__(self, image_HW3: Pixels, step_px: int, mask_HW: Pixels) -> LocalFeatures:
        """Of a point in each square of `step_px` pixels, where `mask_HW` is not 0."""
        ...


def find_features(image_HW3: Pixels, most: int, mask_HW: Pixels | None = None) -> LocalFeatures:
    """The points of the strongest contrast, at most `most`; only where `mask_HW` is not 0."""
    grey_HW = cv2.cvtColor(image_HW3, cv2.COLOR_RGB2GRAY)
    sift = cv2.SIFT.create(nfeatures=most, contrastThreshold=LEAST_CONTRAST)
    points, descriptors_ND = sift.detectAndCompute(grey_HW, mask_HW)
    if descriptors_ND is None:
        return LocalFeatures(
            points_N2=np.zeros((0, 2)),
            descriptors_ND=np.zeros((0, 128), np.float32),
            angles_N=np.zeros(0, np.float32),
        )
    total_N1 = descriptors_ND.sum(axis=1, keepdims=True)
    return LocalFeatures(
        points_N2=np.array([point.pt for point in points]) + 0.5,
        descriptors_ND=np.sqrt(descriptors_ND / np.maximum(total_N1, 1e-12)).astype(np.float32),
        angles_N=np.array([point.angle for point in points], np.float32),
    )


def match_features(one_ND: Floats, other_ND: Floats, ratio: float) -> Ints:
    """Pairs (M, 2) of descriptors, numbers in `one` and `other`: mutually nearest, and nearer than
    `ratio` times the distance of the second nearest."""
    if len(one_ND) == 0 or len(other_ND) < 2:
        return np.zeros((0, 2), np.int64)
    similarity_NM = one_ND @ other_ND.T
    nearest_N = similarity_NM.argmax(axis=1)
    rows_N = np.arange(len(nearest_N))
    best_N = similarity_NM[rows_N, nearest_N]
    similarity_NM[rows_N, nearest_N] = -1
    second_N = similarity_NM.max(axis=1)
    similarity_NM[rows_N, nearest_N] = best_N
    # Of unit vectors the squared distance is 2 - 2 * cosine.
    clear = np.flatnonzero(1 - best_N < ratio**2 * (1 - second_N))
    # Down the columns of the few that are left: down all of them takes as long as all before.
    mutual_M = similarity_NM[:, nearest_N[clear]].argmax(axis=0) == clear
    kept = clear[mutual_M]
    return np.stack([kept, nearest_N[kept]], axis=1)


def match_mutually(one_ND: Floats, other_ND: Floats) -> Ints:
    """Pairs (M, 2) of descriptors, numbers in `one` and `other`: each the other's nearest."""
    if len(one_ND) == 0 or len(other_ND) == 0:
        return np.zeros((0, 2), np.int64)
    nearest_N = (one_ND @ other_ND.T).argmax(axis=1)
    # Computed again for the nearest alone: columns of all similarities would take longer to gather.
    back_N = (other_ND[nearest_N] @ one_ND.T).argmax(axis=1)
    kept = np.flatnonzero(back_N == np.arange(len(one_ND)))
    return np.stack([kept, nearest_N[kept]], axis=1)
