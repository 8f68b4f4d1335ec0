"""The flight around a building as in University-1652: a plan and a radius come in, poses go out.

University-1652 circles each building in three turns while the altitude falls from 256 m to 121.5 m,
and keeps 54 views.
"""

from dataclasses import dataclass
from math import atan, cos, degrees, radians, sin, tan

UNIVERSITY_VIEWS = 54


@dataclass(frozen=True, kw_only=True)
class Pose:
    """Position and direction of a camera without roll; (0, 0) is the world's middle, y north."""

    x_m: float
    y_m: float
    altitude_m: float
    heading_deg: float
    """Clockwise from north, 0 to 360."""
    pitch_deg: float
    """Angle above the horizon: -90 looks straight down."""
    fov_deg: float
    """Field of view across the frame, which is square."""


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
            away = altitude / tan(radians(down))
            flown.append(
                Pose(
                    x_m=-away * sin(radians(heading)),
                    y_m=-away * cos(radians(heading)),
                    altitude_m=altitude,
                    heading_deg=heading,
                    pitch_deg=-down,
                    fov_deg=fov,
                )
            )
        return flown
