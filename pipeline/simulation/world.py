"""A place as the renderer sees it: what a maker of worlds hands over, nothing about light or
cameras.

Axes: x points east and y north in metres, with (0, 0) the middle of the map; row 0 of every map is
the northern edge. Letters: H, W pixels of the map; 3 red, green, blue; K styles of facade.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatMap = NDArray[np.floating[Any]]
"""float32 wherever it runs; NumPy's stubs lose that at the first product with a Python number."""
ByteMap = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class Facade:
    """How the walls of a building look. Colours are sRGB, 0 to 255; lengths are metres."""

    wall: tuple[float, float, float]
    glass: tuple[float, float, float]
    storey_m: float = 3.5
    """Height of one storey: the period of the windows upwards."""
    bay_m: float = 3.0
    """Width of one bay: the period of the windows along the wall."""
    window_wide: float = 0.5
    """Part of the bay that is glass, 0 to 1; 1 makes ribbons."""
    window_high: float = 0.5
    """Part of the storey that is glass, 0 to 1; 0 makes a blind wall."""


@dataclass(frozen=True, kw_only=True)
class World:
    """A square map of colours and heights, and what is needed to light it on any day."""

    texture_HW3: ByteMap
    """Colour seen from above: without light and shadow unless `light_is_baked`."""
    height_HW: FloatMap
    """Metres above the ground plane, never negative."""
    metres_per_pixel: float
    target_radius_m: float
    """Half the extent of the building, or scene, in the middle: what a flight circles and what
    fills its last frame.
    """
    grass_HW: ByteMap
    """How much of the colour is grass, 0 to 255: it yellows with the season."""
    trees_HW: ByteMap
    """How much of the colour is leaves that turn and fall, 0 to 255."""
    facade_HW: ByteMap
    """1-based number of the facade of the building that covers the pixel; 0 where there is no
    building.
    """
    along_HW: FloatMap
    """Metres along the nearest wall, where there is a building: where its windows sit."""
    facing_HW: FloatMap
    """Compass direction (radians, clockwise from north) that the nearest wall faces."""
    facades_K: tuple[Facade, ...] = ()
    light_is_baked: bool = False
    """True of photographs: sun and shadows are in the colours already."""

    def __post_init__(self) -> None:
        shape = self.height_HW.shape
        if len(shape) != 2 or shape[0] != shape[1]:
            raise ValueError(
                f"height map of shape {shape}: expected a square; cut it to its middle square"
            )
        if self.texture_HW3.shape != (*shape, 3):
            raise ValueError(
                f"texture of shape {self.texture_HW3.shape} over heights of shape {shape}: expected the same height "
                "and width and 3 colours; resize one to the other"
            )

    @property
    def extent_m(self) -> float:
        """Length of a side, metres."""
        return float(self.height_HW.shape[0] * self.metres_per_pixel)
