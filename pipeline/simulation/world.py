"""The renderer's input: maps of colours, heights and facades, without light or cameras.

Axes: x points east and y north in metres, with (0, 0) the middle of the map; row 0 of every map is
the northern edge.
Letters: H, W pixels of the map; 3 red, green, blue; K styles of facade.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatMap = NDArray[np.floating[Any]]
"""float32 at run time; NumPy's stubs lose that at the first product with a Python number."""
ByteMap = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class Facade:
    """The look of a building's walls. Colours are sRGB, 0 to 255; lengths are metres."""

    wall: tuple[float, float, float]
    glass: tuple[float, float, float]
    storey_m: float = 3.5
    """Height of one storey: the vertical period of the windows."""
    bay_m: float = 3.0
    """Width of one bay: the period of the windows along the wall."""
    window_wide: float = 0.5
    """Fraction of the bay that is glass; 1 makes ribbons."""
    window_high: float = 0.5
    """Fraction of the storey that is glass; 0 makes a blind wall."""


@dataclass(frozen=True, kw_only=True)
class World:
    """Square maps of colours and heights, with the data to light them on any day."""

    texture_HW3: ByteMap
    """Colour from above: without light and shadow unless `light_is_baked`."""
    height_HW: FloatMap
    """Metres above the ground plane, never negative."""
    metres_per_pixel: float
    target_radius_m: float
    """Half the extent of the central building or scene: flights circle it, and the last frame shows
    all of it.
    """
    grass_HW: ByteMap
    """Fraction of grass in the colour, 0 to 255: grass changes with the season."""
    trees_HW: ByteMap
    """Fraction of deciduous leaves in the colour, 0 to 255."""
    facade_HW: ByteMap
    """1-based number of the facade of the building over the pixel; 0 without a building."""
    along_HW: FloatMap
    """Metres along the nearest wall of a building: the position of its windows."""
    facing_HW: FloatMap
    """Compass direction (radians, clockwise from north) that the nearest wall faces."""
    facades_K: tuple[Facade, ...] = ()
    light_is_baked: bool = False
    """True for photographs: their colours include sun and shadows."""

    def __post_init__(self) -> None:
        shape = self.height_HW.shape
        if len(shape) != 2 or shape[0] != shape[1]:
            raise ValueError(
                f"height map of shape {shape}: expected a square; cut it to its middle square"
            )
        if self.texture_HW3.shape != (*shape, 3):
            raise ValueError(
                f"texture of shape {self.texture_HW3.shape} over heights of shape {shape}: "
                "expected the same height and width and 3 colours; resize one to the other"
            )

    @property
    def extent_m(self) -> float:
        """Length of a side, metres."""
        return float(self.height_HW.shape[0] * self.metres_per_pixel)
