"""A UAV image as it looks from above: its pose lays it on flat ground, north up.

The first stage of PCL (Tian, TCSVT 2021): a perspective projection of the oblique image to a
vertical one. Exact for the ground plane; walls and roofs lean outwards. How the paper chose its
four points is not known; here the pose that the shards carry tells them [chosen]. In: pixels, and
the geotag beside them. Out: pixels, or the same ones where the pose is not known.
"""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from pipeline.camera.framing import lay_on_ground, shows_no_sky
from pipeline.camera.ground import apply_homography, corners, photo_to_ground
from pipeline.camera.lens import field_of_view
from pipeline.camera.local_plane import LocalPlane
from pipeline.camera.pose import PartialPose
from pipeline.core.arrays import Doubles, Pixels

ASSUMED_FOV_DEG = 60.0
"Across the image's width, where only heading and pitch are known: Google Earth's [chosen]."
LEAST_GROUND_M2 = 1.0
"Corners around less ground are no footprint."
LOOKS_DOWN_DEG = -89.5
"Below it an image whose top is north is an overhead one already."


def overhead_view(photo_HW3: Pixels, geotag: Mapping[str, Any] | None) -> Pixels:
    """The ground around the image's middle, a north-up square as wide as the ground that the middle
    row shows; ground beyond the image takes its mean colour.

    `geotag`: of a sample's metadata. By its footprint, else by heading, pitch, roll and focal
    length (or `fov_deg`; ASSUMED_FOV_DEG without either); without a pitch, or with sky in view, the
    image stays as it is.
    """
    height, width = photo_HW3.shape[:2]
    to_ground_33 = _to_ground(geotag or {}, (width, height))
    if to_ground_33 is None or not shows_no_sky(to_ground_33, (width, height)):
        return photo_HW3
    row_22 = np.array([[0, height / 2], [width, height / 2]])
    left_2, right_2 = apply_homography(to_ground_33, row_22)
    return lay_on_ground(photo_HW3, to_ground_33, float(np.linalg.norm(right_2 - left_2)))


def _to_ground(geotag: Mapping[str, Any], size: tuple[int, int]) -> Doubles | None:
    """The homography (33) from pixels to (east, north), in metres or in the camera's heights."""
    outline_42 = _outline(geotag.get("footprint"))
    if outline_42 is not None:
        plane = LocalPlane(lat=float(outline_42[:, 0].mean()), lon=float(outline_42[0, 1]))
        ground_42 = plane.to_metres(outline_42).astype(np.float32)
        if not cv2.isContourConvex(ground_42) or cv2.contourArea(ground_42) < LEAST_GROUND_M2:
            return None
        found_33 = cv2.getPerspectiveTransform(corners(size).astype(np.float32), ground_42)
        # The sign that makes the third coordinate positive in the middle.
        return np.asarray(found_33 * np.sign(found_33[2] @ [size[0] / 2, size[1] / 2, 1]))
    heading, pitch = (_number(geotag.get(name)) for name in ("heading_deg", "pitch_deg"))
    if pitch is None or not -90 <= pitch < 0:
        return None
    if pitch <= LOOKS_DOWN_DEG and not (heading or 0.0) % 360:
        return None
    fov, focal, roll = (_number(geotag.get(name)) for name in ("fov_deg", "focal_35mm", "roll_deg"))
    fov = fov or field_of_view(size, focal_35mm=focal) or ASSUMED_FOV_DEG
    pose = PartialPose(
        heading_deg=heading or 0.0, pitch_deg=pitch, height_m=1.0, fov_deg=fov,
        roll_deg=roll or 0.0,
    )  # fmt: skip
    return photo_to_ground(pose.over(), size)


def _outline(footprint: Any) -> Doubles | None:
    """Four corners (4, 2), latitude and longitude; None for anything else."""
    try:
        outline_42 = np.asarray(footprint, np.float64)
    except (TypeError, ValueError):
        return None
    fits = outline_42.shape == (4, 2) and bool(np.isfinite(outline_42).all())
    return outline_42 if fits and bool((np.abs(outline_42[:, 0]) < 89).all()) else None


def _number(value: Any) -> float | None:
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if plain and np.isfinite(value) else None
