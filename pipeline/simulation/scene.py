"""A world on one day, prepared for the renderer: lit, packed, mirror-padded, with coarse maxima.

Letters: H, W pixels of the padded map; h, w its coarse maxima.
"""

from dataclasses import dataclass
from math import ceil
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.appearance import Day, light_world
from pipeline.simulation.walls import FacadeTable
from pipeline.simulation.world import ByteMap, FloatMap, World

Number = TypeVar("Number", bound=np.generic)

REACH_IN_RADII = 4.5
"""Distance from the middle that a frame of the default flight shows, in target radii."""
COARSE_CELL_PX = 8
"""Side of a cell of the coarse map, map pixels."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A world on one day, padded by its mirror image, each colour packed into one number."""

    packed_HW: NDArray[np.uint32]
    height_HW: FloatMap
    shadow_top_HW: FloatMap
    coarse_hw: FloatMap
    facade_HW: ByteMap
    along_HW: FloatMap
    facing_HW: FloatMap
    facades: FacadeTable
    origin: float
    """Column and row of the world's middle."""
    metres_per_pixel: float
    day: Day
    curve_3V: ByteMap


def prepare_scene(world: World, day: Day) -> Scene:
    """Light the world and lay out its maps; once per day, for every frame of it."""
    lit = light_world(world, day)
    side = world.height_HW.shape[0]
    pad = max(
        2 * COARSE_CELL_PX,
        ceil(REACH_IN_RADII * world.target_radius_m / world.metres_per_pixel - side / 2),
    )
    # The coarse map needs a multiple of its cell.
    extra = -(side + 2 * pad) % COARSE_CELL_PX
    widths = ((pad, pad + extra), (pad, pad + extra))

    def padded(map_HW: NDArray[Number]) -> NDArray[Number]:
        return np.pad(map_HW, widths, mode="symmetric")

    c = lit.colour_HW3.astype(np.uint32)
    packed_HW: NDArray[np.uint32] = (
        c[..., 0] | c[..., 1] << np.uint32(8) | c[..., 2] << np.uint32(16)
    )
    height_HW = padded(world.height_HW)
    return Scene(
        packed_HW=padded(packed_HW),
        height_HW=height_HW,
        shadow_top_HW=padded(lit.shadow_top_HW),
        coarse_hw=_coarse_maxima(height_HW),
        facade_HW=padded(world.facade_HW),
        along_HW=padded(world.along_HW),
        facing_HW=padded(world.facing_HW),
        facades=FacadeTable.from_facades(world.facades_K),
        origin=side / 2 + pad,
        metres_per_pixel=world.metres_per_pixel,
        day=day,
        curve_3V=day.curve_3V(),
    )


def _coarse_maxima(height_HW: FloatMap) -> FloatMap:
    """Per cell the maximum over it and its eight neighbours."""
    h, w = height_HW.shape[0] // COARSE_CELL_PX, height_HW.shape[1] // COARSE_CELL_PX
    cells = height_HW.reshape(h, COARSE_CELL_PX, w, COARSE_CELL_PX).max(axis=(1, 3))
    edged = np.pad(cells, 1, mode="edge")
    rows = np.maximum(np.maximum(edged[:-2], edged[1:-1]), edged[2:])
    maxima: FloatMap = np.maximum(np.maximum(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:])
    return np.ascontiguousarray(maxima)
