"""The flight around a building, as University-1652 flew it: a plan and a radius come in, camera
poses go out.

University-1652 tours each building in three turns while the altitude falls from 256 m to 121.5 m,
and keeps 54 views.
"""

from dataclasses import dataclass
from math import atan, cos, degrees, radians, sin, tan

UNIVERSITY_VIEWS = 54


@dataclass(frozen=True, kw_only=True)
class Pose:
    """Where a camera is and looks; it never rolls. (0, 0) is the middle of the world, x east, y
    north.
    """

    x_m: float
    y_m: float
    altitude_m: float
    heading_deg: float
    """Clockwise from north, 0 to 360."""
    pitch_deg: float
    """Above the horizon: -90 looks straight down."""
    fov_deg: float
    """Angle across the frame, which is square."""


@dataclass(frozen=True, kw_only=True)
class FlightPlan:
    """A descending spiral that looks at the middle of the world all the way."""

    views: int = UNIVERSITY_VIEWS
    """Pictures taken, evenly from the first to the last of University-1652's 54."""
    turns: float = 3.0
    """University-1652: three, 20 degrees from one view to the next; the last view stops one step
    short.
    """
    altitude_start_m: float = 256.0
    """University-1652."""
    altitude_end_m: float = 121.5
    """University-1652."""
    depression_start_deg: float = 55.0
    """How far below the horizon the camera looks at the start. Chosen: the data set does not tell.
    """
    depression_end_deg: float = 45.0
    """The same at the end. Chosen."""
    fill: float = 0.85
    """Part of the last frame's width that the building's extent takes up. Chosen."""
    fov_min_deg: float = 24.0
    """A smaller scene is flown lower instead of through a longer lens. Chosen: keeps perspective
    visible.
    """

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
                f"altitudes {self.altitude_start_m} and {self.altitude_end_m} m: expected 0 < end <= start"
            )

    def lens(self, radius_m: float) -> tuple[float, float]:
        """(field of view in degrees, scale of all altitudes) with which a scene of this radius
        fills the last frame.
        """
        slant = self.altitude_end_m / sin(radians(self.depression_end_deg))
        half = atan(radius_m / (self.fill * slant))
        least = radians(self.fov_min_deg) / 2
        if half >= least:
            return degrees(2 * half), 1.0
        return self.fov_min_deg, tan(half) / tan(least)

    def poses(self, *, radius_m: float, first_heading_deg: float = 0.0) -> list[Pose]:
        """The views in order; the first looks along `first_heading_deg`."""
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
            # Fewer views keep the ends, so their headings do not fall together as a third of three
            # turns would.
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
