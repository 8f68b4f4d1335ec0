"""A photo and the flat ground below it: the homography between them, in both directions.

Pixels are (column, row) with (0, 0) the outer corner of the upper left pixel, so that a photo of W
x H pixels has its middle at (W / 2, H / 2). The ground is (east, north) in metres, relative to the
pose's own zero. [Hartley and Zisserman, Multiple View Geometry, 2nd edition, section 8.1]
Shapes: N points, 33 = a homography, acting on (x, y, 1).
"""

import numpy as np

from pipeline.camera.pose import Pose
from pipeline.core.arrays import Doubles

FLATTEST_DEG = 3.0
"Rays that are less below the horizon meet flat ground too far away to mean anything."


class HorizonInView(ValueError):
    """Part of the photo shows the sky, or ground without end."""


def camera_axes(pose: Pose) -> Doubles:
    """Unit vectors (3, 3) in east, north, up: the columns are the image's right, its downward
    direction, and the optical axis."""
    heading, pitch, roll = np.radians([pose.heading_deg, pose.pitch_deg, pose.roll_deg])
    forward_3 = np.array(
        [np.sin(heading) * np.cos(pitch), np.cos(heading) * np.cos(pitch), np.sin(pitch)]
    )
    level_3 = np.array([np.cos(heading), -np.sin(heading), 0.0])
    below_3 = np.cross(forward_3, level_3)
    right_3 = np.cos(roll) * level_3 + np.sin(roll) * below_3
    down_3 = np.cos(roll) * below_3 - np.sin(roll) * level_3
    return np.asarray(np.stack([right_3, down_3, forward_3], axis=1))


def focal_length_px(fov_deg: float, width: int) -> float:
    """Focal length in pixels of a lens with this field of view across `width` pixels."""
    return float(width / 2 / np.tan(np.radians(fov_deg) / 2))


def photo_to_ground(pose: Pose, size: tuple[int, int]) -> Doubles:
    """The homography (33) from pixels of a photo of `size` (width, height) to the ground.

    The third coordinate of a mapped pixel is positive where its ray meets the ground.
    """
    width, height = size
    focal = focal_length_px(pose.fov_deg, width)
    rays_33 = camera_axes(pose) @ np.array(
        [[1, 0, -width / 2], [0, 1, -height / 2], [0, 0, focal]], np.float64
    )
    scale_3 = -rays_33[2] / pose.altitude_m
    return np.stack([rays_33[0] + pose.x_m * scale_3, rays_33[1] + pose.y_m * scale_3, scale_3])


def ground_to_photo(pose: Pose, size: tuple[int, int]) -> Doubles:
    """The homography (33) from the ground to pixels of a photo of `size` (width, height)."""
    return np.asarray(np.linalg.inv(photo_to_ground(pose, size)), np.float64)


def apply_homography(homography_33: Doubles, points_N2: Doubles) -> Doubles:
    """The points (N, 2) that points (N, 2) are mapped to."""
    mapped_N3 = np.c_[points_N2, np.ones(len(points_N2))] @ homography_33.T
    return np.asarray(mapped_N3[:, :2] / mapped_N3[:, 2:])


def corners(size: tuple[int, int]) -> Doubles:
    """Corners (4, 2) of a photo of `size` (width, height), from the upper left clockwise."""
    width, height = size
    return np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float64)


def footprint(pose: Pose, size: tuple[int, int]) -> Doubles:
    """The ground (4, 2) at the photo's corners, from its upper left clockwise, metres.

    Raises HorizonInView where a corner looks less than FLATTEST_DEG below the horizon.
    """
    width, height = size
    rays_4 = (
        camera_axes(pose)
        @ np.c_[
            corners(size) - (width / 2, height / 2),
            np.full(4, focal_length_px(pose.fov_deg, width)),
        ].T
    )
    below_4 = np.degrees(np.arcsin(-rays_4[2] / np.linalg.norm(rays_4, axis=0)))
    if below_4.min() < FLATTEST_DEG:
        raise HorizonInView(
            f"a corner of the photo looks {below_4.min():.0f} degrees below the horizon, expected "
            f"{FLATTEST_DEG:.0f} or more; pitch {pose.pitch_deg:g}, view {pose.fov_deg:g} degrees"
        )
    return apply_homography(photo_to_ground(pose, size), corners(size))


def looked_at(pose: Pose) -> tuple[float, float]:
    """The ground (east, north) in the middle of the photo, metres.

    Raises HorizonInView where the optical axis does not meet the ground.
    """
    if pose.pitch_deg > -FLATTEST_DEG:
        raise HorizonInView(f"a pitch of {pose.pitch_deg:g} degrees looks at no ground")
    pitch, heading = np.radians([pose.pitch_deg, pose.heading_deg])
    away_m = pose.altitude_m / np.tan(-pitch)
    return pose.x_m + float(away_m * np.sin(heading)), pose.y_m + float(away_m * np.cos(heading))


def heading_of(homography_33: Doubles, size: tuple[int, int]) -> float:
    """Degrees clockwise from north in which the middle of a photo points upwards, by its
    homography to the ground (east, north)."""
    width, height = size
    pixels_22 = np.array([[width / 2, height / 2 + 1], [width / 2, height / 2 - 1]])
    below, above = apply_homography(homography_33, pixels_22)
    east, north = above - below
    return float(np.degrees(np.arctan2(east, north)) % 360)


def camera_above(
    homography_33: Doubles, size: tuple[int, int], fov_deg: float
) -> tuple[float, float, float]:
    """The camera's own (east, north, height) in metres, by a photo's homography to the ground and
    its field of view.

    The inverse homography is K [r1 r2 t] up to its scale, which the two columns' lengths fix.
    [Zhang, A flexible new technique for camera calibration, 2000, section 3.1]
    """
    width, height = size
    focal = focal_length_px(fov_deg, width)
    k_33 = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    columns_33 = np.linalg.solve(k_33, np.linalg.inv(homography_33))
    columns_33 /= np.sqrt(np.linalg.norm(columns_33[:, 0]) * np.linalg.norm(columns_33[:, 1]))
    [middle_2] = apply_homography(homography_33, np.array([[width / 2, height / 2]]))
    if columns_33[2] @ [*middle_2, 1] < 0:  # the ground lies in front of the camera
        columns_33 = -columns_33
    east_3, north_3, shift_3 = columns_33.T
    turned_33 = np.stack([east_3, north_3, np.cross(east_3, north_3)], axis=1)
    left, _, right = np.linalg.svd(turned_33)
    east, north, up = -(left @ right).T @ shift_3
    return float(east), float(north), float(up)
