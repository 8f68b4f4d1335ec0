"""The settings of an adaptation: the flags of jobs/adapt.py.

Imports nothing heavy, so that the command line is parsed at once.
"""

from dataclasses import dataclass
from typing import Annotated

from pipeline.core.errors import require
from pipeline.simulation.over_map.settings import SURFACE_FLAG, CameraRanges


@dataclass(frozen=True, kw_only=True)
class AdaptSettings(CameraRanges):
    """The map, how the UAV flies over it, and how much is spent on it."""

    mosaic: str
    """The map: a GeoTIFF of any coordinate system and size; or a folder of such that are the sheets
    of one map, or GDAL's description of them (.vrt)."""
    out: str
    "Folder of the region: tiles, encoder, index, calibration and the page; local or mounted."
    surface: Annotated[str | None, SURFACE_FLAG] = None
    "A surface model (as the map, in metres): relief, parallax. None: the ground is taken for flat."
    photos: str | None = None
    """Folder of photos of the UAV: their tags, where they have them, set --height, --pitch and
    --fov of the simulated ones; from 96 on the encoder is aligned with what they look like, without
    any labels; and where they have GPS, the page shows the real error."""
    minutes: float = 20.0
    "Of fine-tuning the built-in encoder; 0 keeps it as it is."
    tile_m: float | tuple[float, ...] = 55.0
    """Side of a tile of the map, metres; the built-in encoder learned of 55. Several, such as 55
    110 220, are levels of the gallery, for photos from different heights."""
    checks: int = 80
    """Simulated photos of held-out places that the confidence is fitted on, and as many again that
    tell what to expect."""
    extend: bool = False
    """Add the map to the region in `out`: its tiles join the gallery, the confidence is fitted anew
    among them, the encoder stays, and the page tells what to expect of all its maps."""
    seed: int = 0
    "Another seed flies elsewhere, on other days."

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.minutes >= 0, "minutes", self.minutes, "0 or more")
        sides = self.tile_sides_m
        rising = sides == tuple(sorted(set(sides)))
        require(bool(sides) and min(sides) > 0 and rising, "tile_m", self.tile_m,
                "metres above 0, rising")  # fmt: skip
        require(self.checks >= 20, "checks", self.checks, "20 or more")
        require(self.seed >= 0, "seed", self.seed, "0 or more")

    @property
    def tile_sides_m(self) -> tuple[float, ...]:
        """Sides of the gallery's levels, metres, rising."""
        return self.tile_m if isinstance(self.tile_m, tuple) else (self.tile_m,)
