"""Candidates of a flight's photo -> where its ground and its camera are if they are right, with
errors.

In: tiles, a refinement, and what is known of the camera's direction. Out: `Places` of the ground
in the photo's middle, and of the camera, which is what moves. NumPy only, no I/O.
Shapes: K candidates, 2 = latitude and longitude in degrees or (east, north) in metres.
"""

import math

import numpy as np

from pipeline.camera.ground import FLATTEST_DEG, looked_at
from pipeline.camera.local_plane import LocalPlane
from pipeline.camera.pose import PartialPose, Pose
from pipeline.camera.uncertainty import (
    WITHIN_95,
    PoseErrors,
    covariance_of,
    looked_at_covariance,
)
from pipeline.core.arrays import Doubles
from pipeline.locate.movement import Places
from pipeline.matching.gate import Gate
from pipeline.matching.refine import Refinement

CAMERA_ERROR = 0.06
"""Standard deviation, in east and in north, of a refinement's camera, as a share of its distance
from the ground in the photo's middle: .055 to .058 in 40 refinements over a town with relief, which
tilts what flat ground would explain (docs/decisions.md)."""


def tile_places(positions_K2: Doubles, half_spacing_K: Doubles) -> Places:
    """The ground of a photo that shows one of these tiles: half a spacing away at most where the
    nearest tile is the candidate; since a neighbour often is, that is one standard deviation."""
    return Places(
        positions_N2=positions_K2,
        slack_N=half_spacing_K,
        covariance_N22=half_spacing_K[:, None, None] ** 2 * np.eye(2),
    )


def camera_places(ground: Places, pose: PartialPose) -> Places:
    """The camera's places, if the ground is what it looks at; unknown where heading, pitch or
    height is."""
    looking = _looking(pose)
    count = len(ground.positions_N2)
    if looking is None or not count:
        return Places.unknown(count)
    ahead_2 = np.array(looked_at(looking))
    covariance_22 = looked_at_covariance(looking, PoseErrors())
    behind_K2 = [
        LocalPlane(lat=lat, lon=lon).to_degrees(-ahead_2[None])[0]
        for lat, lon in ground.positions_N2.tolist()
    ]
    return Places(
        positions_N2=np.array(behind_K2),
        slack_N=ground.slack_N + WITHIN_95 * _longest(covariance_22),
        covariance_N22=ground.covariance_N22 + covariance_22,
    )


def gaze_ahead_m(pose: PartialPose) -> float:
    """Metres from below the camera to the ground in the photo's middle, by its pitch and height; 0
    where they are not known."""
    pitch, height = pose.pitch_deg, pose.height_m
    if pitch is None or height is None or pitch > -FLATTEST_DEG:
        return 0.0
    return height / math.tan(math.radians(-pitch))


def refined_place(refinement: Refinement, gate: Gate) -> tuple[Places, Places]:
    """The ground of a refinement, and its camera where the lens is known."""
    ellipse = gate.ellipse(refinement)
    covariance_22 = covariance_of(ellipse)
    ground = Places(
        positions_N2=np.array([[refinement.lat, refinement.lon]]),
        slack_N=np.array([ellipse.major_m]),
        covariance_N22=covariance_22[None],
    )
    if refinement.camera is None:
        return ground, Places.unknown(1)
    *camera_2, height_m = refinement.camera
    plane = LocalPlane(lat=refinement.lat, lon=refinement.lon)
    [[east, north]] = plane.to_metres(np.array([camera_2])).tolist()
    error_m = CAMERA_ERROR * math.hypot(east, north, height_m)
    return ground, Places(
        positions_N2=np.array([camera_2]),
        slack_N=np.array([math.hypot(ellipse.major_m, WITHIN_95 * error_m)]),
        covariance_N22=(covariance_22 + error_m**2 * np.eye(2))[None],
    )


def _looking(pose: PartialPose) -> Pose | None:
    """The pose above (0, 0); the lens plays no part in it."""
    heading, pitch, height = pose.heading_deg, pose.pitch_deg, pose.height_m
    if heading is None or pitch is None or height is None or pitch > -FLATTEST_DEG:
        return None
    return Pose(
        x_m=0, y_m=0, altitude_m=height, heading_deg=heading, pitch_deg=pitch,
        fov_deg=pose.fov_deg or 60.0, roll_deg=pose.roll_deg,
    )  # fmt: skip


def _longest(covariance_22: Doubles) -> float:
    """The largest standard deviation in any direction."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance_22)[-1]))
