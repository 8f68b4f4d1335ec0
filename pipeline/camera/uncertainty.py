"""How errors of a pose move the ground that a photo's middle shows.

In: a pose and the standard deviations of its parts. Out: a covariance of (east, north), and its
ellipse. First order: the errors' effect is linear within them.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from pipeline.camera.ground import looked_at
from pipeline.camera.pose import Pose
from pipeline.core.arrays import Doubles

STEP = 1e-3
"Of the central differences, in degrees and metres."
WITHIN_95 = 2.4477
"An ellipse of so many standard deviations holds 95 % of a normal distribution in the plane."


@dataclass(frozen=True, kw_only=True)
class PoseErrors:
    """Standard deviations of a pose's parts. The defaults are those of a small UAV's gimbal and
    compass; height is a share of itself."""

    heading_deg: float = 3.0
    pitch_deg: float = 1.0
    height_share: float = 0.03
    position_m: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Ellipse:
    """An ellipse around a position that holds it with a probability of 95 %, if it is right."""

    major_m: float
    "Half the longer axis, metres."
    minor_m: float
    "Half the shorter axis."
    direction_deg: float
    "Of the longer axis, degrees clockwise from north, 0 to 180."

    def widened(self, radius_m: float) -> "Ellipse":
        """The ellipse with an independent error of 95 % within `radius_m`, in any direction,
        added."""
        return replace(
            self,
            major_m=math.hypot(self.major_m, radius_m),
            minor_m=math.hypot(self.minor_m, radius_m),
        )

    def holds(self, east_m: float, north_m: float) -> bool:
        """Whether a point so far from its middle lies within it."""
        direction = math.radians(self.direction_deg)
        along = east_m * math.sin(direction) + north_m * math.cos(direction)
        across = east_m * math.cos(direction) - north_m * math.sin(direction)
        if not self.minor_m or not self.major_m:
            return False
        return math.hypot(along / self.major_m, across / self.minor_m) <= 1


def looked_at_covariance(pose: Pose, errors: PoseErrors) -> Doubles:
    """The covariance (2, 2) in square metres of the ground in the photo's middle.

    Raises HorizonInView where the pose looks at no ground.
    """
    deviations = {
        "heading_deg": errors.heading_deg,
        "pitch_deg": errors.pitch_deg,
        "altitude_m": errors.height_share * pose.altitude_m,
        "x_m": errors.position_m,
        "y_m": errors.position_m,
    }
    columns = []
    for name, deviation in deviations.items():
        value = getattr(pose, name)
        more = np.array(looked_at(replace(pose, **{name: value + STEP})))
        less = np.array(looked_at(replace(pose, **{name: value - STEP})))
        columns.append((more - less) / (2 * STEP) * deviation)
    effects_25 = np.stack(columns, axis=1)
    return np.asarray(effects_25 @ effects_25.T)


def ellipse_of(covariance_22: Doubles) -> Ellipse:
    """The 95 % ellipse of a covariance of (east, north) in square metres."""
    variance_2, axes_22 = np.linalg.eigh(covariance_22)
    minor, major = WITHIN_95 * np.sqrt(np.maximum(variance_2, 0))
    east, north = axes_22[:, 1]
    direction = float(np.degrees(np.arctan2(east, north)) % 180)
    return Ellipse(major_m=float(major), minor_m=float(minor), direction_deg=direction)


def covariance_of(ellipse: Ellipse) -> Doubles:
    """The covariance (2, 2) of (east, north) in square metres of which this is the 95 % ellipse."""
    direction = math.radians(ellipse.direction_deg)
    along_2 = np.array([math.sin(direction), math.cos(direction)])
    across_2 = np.array([math.cos(direction), -math.sin(direction)])
    major, minor = ellipse.major_m / WITHIN_95, ellipse.minor_m / WITHIN_95
    return np.asarray(
        major**2 * np.outer(along_2, along_2) + minor**2 * np.outer(across_2, across_2)
    )
