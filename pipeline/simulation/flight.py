"""The flight over a location: a plan and a radius come in, poses go out.

University-1652 circles each building in three turns while the altitude falls from 256 m to 121.5 m,
and keeps 54 views: `FlightPlan`. A `FreeFlight` comes by from anywhere, as a UAV on its way does.
"""

from dataclasses import dataclass
from math import atan, cos, degrees, radians, sin, tan

import numpy as np

from pipeline.camera.pose import Pose

UNIVERSITY_VIEWS = 54


@dataclass(frozen=True, kw_only=True)
class FlightPlan:
    """A descending spiral; the camera always looks at the middle of the world."""

    views: int = UNIVERSITY_VIEWS
    """Number of images, evenly spaced from the first to the last of University-1652's 54."""
    turns: float = 3.0
    """University-1652: three, 20 degrees between views; the last view is one step short."""
    altitude_start_m: float = 256.0
    """University-1652."""
    altitude_end_m: float = 121.5
    """University-1652."""
    depression_start_deg: float = 55.0
    """Camera angle below the horizon at the start. Chosen: the data set does not state it."""
    depression_end_deg: float = 45.0
    """Camera angle below the horizon at the end. Chosen."""
    fill: float = 0.85
    """Fraction of the last frame's width that the building takes up. Chosen."""
    fov_min_deg: float = 24.0
    """Smallest field of view: smaller scenes are flown lower. Chosen: keeps perspective visible."""

    def __post_init__(self) -> None:
        if self.views < 1:
            raise ValueError(f"views is {self.views}: expected 1 or more")
        if not 0 < self.depression_end_deg <= self.depression_start_deg < 80:
            raise ValueError(
                f"depressions {self.depression_start_deg} and {self.depression_end_deg} degrees: "
                "expected 0 < end <= start < 80"
            )
        if not 0 < self.altitude_end_m <= self.altitude_start_m:
            raise ValueError(
                f"altitudes {self.altitude_start_m} and {self.altitude_end_m} m: "
                "expected 0 < end <= start"
            )

    def lens(self, radius_m: float) -> tuple[float, float]:
        """(field of view in degrees, scale of altitudes): the radius then fills the last frame."""
        slant = self.altitude_end_m / sin(radians(self.depression_end_deg))
        half = atan(radius_m / (self.fill * slant))
        least = radians(self.fov_min_deg) / 2
        if half >= least:
            return degrees(2 * half), 1.0
        return self.fov_min_deg, tan(half) / tan(least)

    def poses(self, *, radius_m: float, first_heading_deg: float = 0.0) -> list[Pose]:
        """Poses of the views in order; the first has the heading `first_heading_deg`."""
        fov, scale = self.lens(radius_m)
        flown = []
        for view in range(self.views):
            done = view / max(1, self.views - 1)
            altitude = scale * (
                self.altitude_start_m + done * (self.altitude_end_m - self.altitude_start_m)
            )
            down = self.depression_start_deg + done * (
                self.depression_end_deg - self.depression_start_deg
            )
            # Fewer views keep both ends of the spiral: with one view per full turn, say, all would
            # have the same heading.
            heading = (
                first_heading_deg
                + 360.0 * self.turns * (UNIVERSITY_VIEWS - 1) / UNIVERSITY_VIEWS * done
            ) % 360.0
            flown.append(
                Pose.looking_at_zero(
                    altitude_m=altitude, heading_deg=heading, pitch_deg=-down, fov_deg=fov
                )
            )
        return flown


LOWEST_RAY_DEG = 22.0
"""Least angle below the horizon of any ray of a free flight's frame: flatter ones see far beyond
the world's edge."""


@dataclass(frozen=True, kw_only=True)
class FreeFlight:
    """Views from any heading, steep or oblique, near or far, with the place off the middle. All
    ranges are chosen."""

    views: int
    """Number of images."""
    steepest_deg: float = 90.0
    """Largest camera angle below the horizon: 90 looks straight down."""
    flattest_deg: float = 40.0
    """Smallest one."""
    narrowest: float = 0.9
    """Half the frame's width on the ground, at its middle, in target radii: at least."""
    widest: float = 2.0
    """Likewise, at most: 1.7 is the satellite image's."""
    fov_deg: tuple[float, float] = (30.0, 65.0)
    """Range of the field of view, of lenses of 28 to 65 mm in 35 mm format."""
    off_centre: float = 0.35
    """Largest distance of the frame's middle from the location's along an axis, in target radii."""
    days: int = 3
    """Days on which the views are taken, in turn."""

    def __post_init__(self) -> None:
        if self.views < 1:
            raise ValueError(f"views is {self.views}: expected 1 or more")
        if not LOWEST_RAY_DEG + 10 <= self.flattest_deg <= self.steepest_deg <= 90:
            raise ValueError(
                f"angles of {self.flattest_deg} to {self.steepest_deg} degrees below the horizon: "
                f"expected {LOWEST_RAY_DEG + 10:.0f} <= flattest <= steepest <= 90"
            )

    def poses(self, *, radius_m: float, rng: np.random.Generator) -> list[Pose]:
        """Poses of the views, each drawn independently."""
        return [self._pose(radius_m, rng) for _ in range(self.views)]

    def _pose(self, radius_m: float, rng: np.random.Generator) -> Pose:
        heading = float(rng.uniform(0, 360))
        down = float(rng.uniform(self.flattest_deg, self.steepest_deg))
        widest_fov = min(self.fov_deg[1], 2 * (down - LOWEST_RAY_DEG))
        fov = float(rng.uniform(min(self.fov_deg[0], widest_fov), widest_fov))
        half_width_m = radius_m * float(rng.uniform(self.narrowest, self.widest))
        slant_m = half_width_m / tan(radians(fov) / 2)
        away_m = slant_m * cos(radians(down))
        east_m, north_m = radius_m * rng.uniform(-self.off_centre, self.off_centre, 2)
        return Pose(
            x_m=float(east_m) - away_m * sin(radians(heading)),
            y_m=float(north_m) - away_m * cos(radians(heading)),
            altitude_m=slant_m * sin(radians(down)),
            heading_deg=heading,
            pitch_deg=-down,
            fov_deg=fov,
        )
