"""The settings of a simulation: the flags of jobs/simulate.py.

Imports nothing heavy, so that the command line is parsed at once.
"""

from dataclasses import dataclass
from typing import Literal

from pipeline.core.errors import InputError, require

MAX_LOCATIONS, MAX_VIEWS = 1_000_000, 10_000
"Beyond any use: a typing mistake fills the memory with plans before it fills the disk."

Flight = Literal["spiral", "free"]
"University-1652's descending spiral, or views from anywhere on several days."


@dataclass(frozen=True, kw_only=True)
class SimulationSettings:
    """The size of a simulated data set, and what it shows."""

    out: str
    "Folder of the data set; a local or mounted path."
    train_locations: int
    "Locations to train on. University-1652: 701."
    test_locations: int
    "Locations with queries. University-1652: 701."
    distractors: int
    "Locations in the gallery only. University-1652: 250."
    views: int = 54
    "UAV images per location, along the whole flight. University-1652: 54."
    flight: Flight = "spiral"
    """How the UAV comes by: `spiral` as in University-1652, or `free`: any heading, 40 to 90
    degrees below the horizon, near and far, the place off the middle, on three days."""
    size: int = 512
    "Side of every image, pixels. University-1652: 512."
    seed: int = 0
    "Another seed makes other locations."
    textures: str | None = None
    "Folder of real overhead images to fly over, one per location; by default procedural towns."
    fill_with_towns: bool = False
    "Locations beyond those images are procedural towns, in place of an error."
    texture_metres_per_pixel: float = 0.3
    "Resolution of those images."
    workers: int | None = None
    """Locations rendered at once, each by a Ray task; None for as many as there are cores, or none
    where all is done before a Ray has started; 0 for one after the other in this process."""

    def __post_init__(self) -> None:
        for name in ("train_locations", "test_locations", "distractors", "seed"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "0 or more")
        this = "0 (this process) or more"
        require(self.workers is None or self.workers >= 0, "workers", self.workers, this)
        total = self.train_locations + self.test_locations + self.distractors
        if total > MAX_LOCATIONS:
            raise InputError(
                f"{total} locations asked for, expected at most {MAX_LOCATIONS}; "
                "make several sets of them"
            )
        if total == 0:
            raise InputError(
                "no locations asked for, expected one or more; "
                "set --train-locations or --test-locations"
            )
        example = "University-1652 has 54"
        require(self.views >= 1, "views", self.views, f"1 or more; {example}")
        require(self.views <= MAX_VIEWS, "views", self.views, f"at most {MAX_VIEWS}; {example}")
        require(
            32 <= self.size <= 1024, "size", self.size, "32 to 1024 pixels; University-1652 has 512"
        )
        resolution = self.texture_metres_per_pixel
        require(
            0 < resolution < float("inf"), "texture_metres_per_pixel", resolution, "more than 0"
        )
