"""The settings of a simulated flight over a map: the flags of jobs/fly.py.

Imports nothing heavy, so that the command line is parsed at once.
"""

from dataclasses import dataclass, fields
from typing import Annotated, Literal

import tyro

from pipeline.camera.cameras import CAMERAS
from pipeline.core.errors import require

SURFACE_FLAG = tyro.conf.arg(aliases=["--dsm"])
DEFAULT_FOV = (45.0, 65.0)
"Degrees: of lenses of 28 to 43 mm in 35 mm format."
Part = Literal["all", "learn", "held-out"]
"The places of a map that are flown over: all, those to learn from, or those kept to check with."


@dataclass(frozen=True, kw_only=True)
class CameraRanges:
    """How a UAV flies and what lens it has: ranges that photos are drawn from."""

    height: tuple[float, float] = (60.0, 120.0)
    "Range of the camera's height above the ground, metres."
    pitch: tuple[float, float] = (-90.0, -45.0)
    "Range of the camera's angle above the horizon, degrees; -90 looks straight down."
    fov: tuple[float, float] | None = None
    """Range of the field of view across a photo's width, degrees; None: that of --camera, else 45
    to 65. A view that would reach within 22 degrees of the horizon is narrowed."""
    camera: str | None = None
    """A camera by its name, such as mavic-3, instead of --fov; an unknown name lists all. Simulated
    photos are square: as wide as the camera's, and higher."""

    def __post_init__(self) -> None:
        low, high = self.pitch
        steep = "two angles from -90 to -35, the steeper first"
        require(-90 <= low <= high <= -35, "pitch", self.pitch, steep)
        low, high = self.height
        require(0 < low <= high <= 2000, "height", self.height, "two heights up to 2,000 m")
        if self.fov is not None:
            low, high = self.fov
            require(5 <= low <= high <= 120, "fov", self.fov, "two angles from 5 to 120 degrees")
        if self.camera is not None:
            none = "none with --camera; leave one of them out"
            require(self.fov is None, "fov", self.fov, none)
            names = f"one of {', '.join(CAMERAS)}; or give its field of view by --fov"
            require(self.camera in CAMERAS, "camera", self.camera, names)

    @property
    def fov_range(self) -> tuple[float, float]:
        """The field of view across a photo's width, degrees: as given, else the camera's."""
        if self.camera is None:
            return self.fov or DEFAULT_FOV
        fov = CAMERAS[self.camera].fov_deg
        return fov, fov

    @property
    def lens(self) -> dict[str, list[float]]:
        """What a record of the settings has of the lens: however it was named."""
        return {"fov": list(self.fov_range)}


Plan = Literal["places", "survey", "spiral"]


@dataclass(frozen=True, kw_only=True)
class PlanSettings:
    """Whether photos are of one flight, and its plan."""

    plan: Plan = "places"
    """Photos of random places. Or of one flight, for which times.csv and odometry.csv are written
    too, as jobs/locate.py reads them: a survey of parallel lines, with the camera fixed to a UAV
    that looks ahead; or a spiral of three turns around one place that the seed draws, as
    University-1652 has them: from the upper end of --height to the lower one at an even distance,
    from which the lowest photo has the flatter end of --pitch; further out where the steeper end
    asks for it."""
    every_m: float = 40.0
    "Of a survey, metres between photos; those of a spiral share its three turns evenly."
    line_m: float = 60.0
    "Of a survey, metres between lines."
    speed: float = 10.0
    "Of a survey or a spiral, metres per second."
    odometry_error: float = 0.05
    """Standard deviation of the odometry's displacement, east and north each, as a share of the
    distance between two photos."""

    def __post_init__(self) -> None:
        for name in ("every_m", "line_m", "speed"):
            require(getattr(self, name) > 0, name, getattr(self, name), "a number above 0")
        error = self.odometry_error
        require(error >= 0, "odometry_error", error, "0 or more")

    def location_of(self, number: int) -> int:
        """The number of the place that photo `number` of a flight shows, or the photos of place
        `number`: that of a spiral is one."""
        return 0 if self.plan == "spiral" else number


UNUSED_FIELDS: dict[Plan, tuple[str, ...]] = {
    "places": tuple(one.name for one in fields(PlanSettings)),
    "survey": (),
    "spiral": ("every_m", "line_m"),
}
"Settings that change nothing, by the plan."


@dataclass(frozen=True, kw_only=True)
class MapFlightSettings(PlanSettings, CameraRanges):
    """The map, and the photos that are taken over it."""

    mosaic: str
    """The map: a GeoTIFF of any coordinate system and size; or a folder of such that are the sheets
    of one map, or GDAL's description of them (.vrt)."""
    out: str
    "Folder of the photos and their table; a local or mounted path."
    photos: int = 200
    "Number of photos."
    views: int = 1
    "Photos of each place, each with a pose and a day of its own."
    overhead_m: float | None = None
    """Write each place's piece of the map too, of so many metres a side: pairs to train and to
    evaluate on. The table then names views and splits: train, or those of the test for --part
    held-out."""
    part: Part = "all"
    """The map is a chessboard of blocks of 160 m, of which one in five is held out; with `held-out`
    the middle of each photo lies well within such a block, with `learn` in no such block."""
    surface: Annotated[str | None, SURFACE_FLAG] = None
    "A surface model (as the map, in metres): relief and parallax. None: the ground is flat."
    relight: bool = True
    """With a surface model: the sun that lit the map is found by its shadows, its light taken away,
    and each photo has that of another day. Without: sun and shadows stay as in the map."""
    size: int = 512
    "Side of a photo, pixels."
    heading_error: float = 3.0
    "Standard deviation of the heading in the photos' tags, degrees."
    pitch_error: float = 1.0
    "Likewise of the pitch."
    height_error: float = 0.03
    "Likewise of the height, as a share of it."
    seed: int = 0
    "Another seed flies elsewhere, on other days."
    workers: int | None = None
    """Photos rendered at once, each by a Ray task; None for as many as there are cores, or none
    where all is done before a Ray has started; 0 for one after the other in this process."""

    def __post_init__(self) -> None:
        PlanSettings.__post_init__(self)
        CameraRanges.__post_init__(self)
        require(self.plan == "places" or self.views == 1, "plan", self.plan,
                "places with --views; a flight takes one photo at a time")  # fmt: skip
        require(self.plan != "survey" or self.part == "all", "plan", self.plan,
                "places or spiral with --part; a survey is of all of the map")  # fmt: skip
        require(self.photos >= 1, "photos", self.photos, "1 or more")
        require(self.views >= 1, "views", self.views, "1 or more")
        side = self.overhead_m
        require(side is None or side > 0, "overhead_m", side, "metres above 0")
        require(64 <= self.size <= 2048, "size", self.size, "64 to 2048 pixels")
        for name in ("heading_error", "pitch_error", "height_error", "seed"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "0 or more")
        this = "0 (this process) or more"
        require(self.workers is None or self.workers >= 0, "workers", self.workers, this)


@dataclass(frozen=True, kw_only=True)
class TownMapSettings:
    """The size of a procedural town, and which."""

    out: str
    "Folder of the maps; a local or mounted path."
    side: float = 1000.0
    "Side of the square that the map shows, metres."
    resolution: float = 0.25
    "Metres per pixel."
    seed: int = 0
    "Another seed makes another town."

    def __post_init__(self) -> None:
        require(100 <= self.side <= 4000, "side", self.side, "100 to 4000 metres")
        metres = "metres per pixel from 0.1 to 2"
        require(0.1 <= self.resolution <= 2, "resolution", self.resolution, metres)
        require(self.seed >= 0, "seed", self.seed, "0 or more")
