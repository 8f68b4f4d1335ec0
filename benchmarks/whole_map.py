"""Plain SIFT of a photo against a whole map: the baseline without encoder, tiles, pose or gate.

Every feature of the map stands in one nearest-neighbour index (FLANN); the photo's pairs are those
of Lowe's ratio, and the homography is that of jobs/locate.py's matching.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from rasterio.warp import transform

from pipeline.camera.ground import apply_homography
from pipeline.core.arrays import Doubles, Pixels
from pipeline.matching.ground_fit import fit_ground, is_camera_view
from pipeline.matching.local_features import LocalFeatures, find_features
from pipeline.matching.photo_features import prepare_photo
from pipeline.matching.refine import TOLERANCE_PX

RATIO = 0.8
"Of the distances of the nearest and the second nearest descriptor [Lowe 2004]."
TREES, CHECKS = 4, 64
"Of FLANN's randomised k-d trees."


@dataclass(frozen=True, kw_only=True)
class WholeMap:
    """A map's features, and its georeference."""

    matcher: Any
    points_N2: Doubles
    "Column and row of each feature."
    to_crs: Any
    "The affine transform from column and row to the map's coordinates."
    crs: Any

    def place(self, photo_HW3: Pixels) -> tuple[float, float] | None:
        """Latitude and longitude of the ground in a photo's middle; None where no view of a camera
        holds."""
        photo = prepare_photo(photo_HW3)
        found: LocalFeatures = photo.features
        if len(found.points_N2) == 0:
            return None
        pairs = [
            (one.queryIdx, one.trainIdx)
            for one, other in self.matcher.knnMatch(found.descriptors_ND, k=2)
            if one.distance < RATIO * other.distance
        ]
        if not pairs:
            return None
        photo_at, map_at = np.array(pairs).T
        # Upwards, as north is: `is_camera_view` expects a ground that is not mirrored.
        ground_M2 = self.points_N2[map_at] * (1, -1)
        fit = fit_ground(found.points_N2[photo_at], ground_M2, photo.size, TOLERANCE_PX)
        if fit is None or not is_camera_view(fit.to_ground_33, photo.size):
            return None
        middle_12 = np.array([[photo.size[0] / 2, photo.size[1] / 2]])
        [[column, up]] = apply_homography(fit.to_ground_33, middle_12).tolist()
        east, north = self.to_crs @ (column, -up)
        lons, lats = transform(self.crs, "EPSG:4326", [east], [north])[:2]
        return lats[0], lons[0]


def open_whole_map(path: Path) -> WholeMap:
    """The features of a GeoTIFF in red, green, blue."""
    with rasterio.open(path) as opened:
        pixels_HW3 = np.ascontiguousarray(opened.read((1, 2, 3)).transpose(1, 2, 0))
        to_crs, crs = opened.transform, opened.crs
    found = find_features(pixels_HW3, most=0)
    matcher = cv2.FlannBasedMatcher({"algorithm": 1, "trees": TREES}, {"checks": CHECKS})
    matcher.add([found.descriptors_ND])
    matcher.train()
    return WholeMap(matcher=matcher, points_N2=found.points_N2, to_crs=to_crs, crs=crs)
