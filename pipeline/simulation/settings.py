"""The settings of a simulation: flags of jobs/simulate.py. Imports nothing heavy, so that
the command line is parsed at once."""

from dataclasses import dataclass

from pipeline.core.errors import InputError

MOST_LOCATIONS, MOST_VIEWS = 1_000_000, 10_000
"Beyond any use: a slip of the keyboard would fill the memory with plans before it fills the disk."


@dataclass(frozen=True, kw_only=True)
class SimulationSettings:
    """How large a data set is made, and of what."""

    out: str
    "Folder of the data set; a local or mounted path."
    train_locations: int
    "Locations to learn from. University-1652: 701."
    test_locations: int
    "Locations with queries. University-1652: 701."
    distractors: int
    "Locations in the gallery only. University-1652: 250."
    views: int = 54
    "UAV pictures per location, along the whole flight. University-1652: 54."
    size: int = 512
    "Side of every picture, pixels. University-1652: 512."
    seed: int = 0
    "Another seed makes another country."
    textures: str | None = None
    "Folder of real overhead images to fly over, one per location; without it, towns are made up."
    texture_metres_per_pixel: float = 0.3
    "Resolution of those images."

    def __post_init__(self) -> None:
        for name in ("train_locations", "test_locations", "distractors", "seed"):
            if getattr(self, name) < 0:
                raise InputError(
                    f"--{name.replace('_', '-')} is {getattr(self, name)}; expected 0 or more"
                )
        if (
            asked := self.train_locations + self.test_locations + self.distractors
        ) > MOST_LOCATIONS:
            raise InputError(
                f"{asked} locations asked for; expected at most {MOST_LOCATIONS}; make several sets of them"
            )
        if asked == 0:
            raise InputError(
                "no locations asked for; expected one or more; set --train-locations or --test-locations"
            )
        if self.views < 1:
            raise InputError(f"--views is {self.views}; expected 1 or more; University-1652 has 54")
        if self.views > MOST_VIEWS:
            raise InputError(
                f"--views is {self.views}; expected at most {MOST_VIEWS}; University-1652 has 54"
            )
        if not 32 <= self.size <= 1024:
            raise InputError(
                f"--size is {self.size}; expected 32 to 1024 pixels; University-1652 has 512"
            )
        if not 0 < self.texture_metres_per_pixel < float("inf"):
            raise InputError(
                f"--texture-metres-per-pixel is {self.texture_metres_per_pixel}; expected more than 0"
            )
