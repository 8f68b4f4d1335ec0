"""Where a camera is and how it looks."""

from dataclasses import dataclass
from math import cos, radians, sin, tan
from typing import Literal

Perspective = Literal["as_taken", "overhead"]
"""Whether UAV images are seen as they were taken, or laid on the ground north up (`overhead.py`),
where the shards say how the camera stood; other views always as they were taken."""


@dataclass(frozen=True, kw_only=True)
class Pose:
    """Position and direction of a camera over flat ground; x is east, y north, in metres from a
    point of the ground that the owner of the pose chooses."""

    x_m: float
    y_m: float
    altitude_m: float
    "Above the ground."
    heading_deg: float
    """Clockwise from north, 0 to 360: of the optical axis; straight down, of the image's top."""
    pitch_deg: float
    """Angle above the horizon: -90 looks straight down."""
    fov_deg: float
    """Field of view across the frame's width."""
    roll_deg: float = 0.0
    "About the optical axis; above 0 the image's right side is the lower one."

    @classmethod
    def looking_at_zero(
        cls, *, altitude_m: float, heading_deg: float, pitch_deg: float, fov_deg: float
    ) -> "Pose":
        """The pose, with this altitude and direction, that has the ground (0, 0) in its middle."""
        away_m = altitude_m / tan(radians(-pitch_deg))
        return cls(
            x_m=-away_m * sin(radians(heading_deg)), y_m=-away_m * cos(radians(heading_deg)),
            altitude_m=altitude_m, heading_deg=heading_deg, pitch_deg=pitch_deg, fov_deg=fov_deg,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class PartialPose:
    """What a photo's tags, a table or flags say of its camera; None is unknown."""

    heading_deg: float | None = None
    "Clockwise from true north."
    pitch_deg: float | None = None
    "Angle above the horizon, -90 to 0."
    height_m: float | None = None
    "Above the ground; cameras mostly state the height above the point of take-off."
    fov_deg: float | None = None
    "Field of view across the width."
    roll_deg: float = 0.0

    @property
    def complete(self) -> bool:
        """Whether the photo can be laid on the ground, up to its position."""
        return None not in (self.heading_deg, self.pitch_deg, self.height_m, self.fov_deg)

    def over(self, x_m: float = 0.0, y_m: float = 0.0) -> Pose:
        """The complete pose of a camera above a point. Raises ValueError where it is not."""
        heading, pitch, height, fov = (
            self.heading_deg, self.pitch_deg, self.height_m, self.fov_deg,
        )  # fmt: skip
        if heading is None or pitch is None or height is None or fov is None:
            raise ValueError(f"{self}: expected heading, pitch, height and field of view")
        return Pose(
            x_m=x_m, y_m=y_m, altitude_m=height, heading_deg=heading, pitch_deg=pitch,
            fov_deg=fov, roll_deg=self.roll_deg,
        )  # fmt: skip
