"""Colours of walls: windows in rows and bays, sun or shade; the dark sides of trees and cars.

Letters: K facades (row 0 unused); M rays that met a wall; 3 red, green, blue.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.appearance import Day
from pipeline.simulation.world import ByteMap, Facade, FloatMap


@dataclass(frozen=True, kw_only=True)
class FacadeTable:
    """The facades of a world as arrays, one row per facade."""

    wall_K3: FloatMap
    glass_K3: FloatMap
    shape_K4: FloatMap
    """Storey and bay in metres, width and height of the windows as fractions of them."""

    @classmethod
    def from_facades(cls, facades: tuple[Facade, ...]) -> "FacadeTable":
        rows = (Facade(wall=(0, 0, 0), glass=(0, 0, 0)), *facades)
        return cls(
            wall_K3=np.asarray([f.wall for f in rows], np.float32),
            glass_K3=np.asarray([f.glass for f in rows], np.float32),
            shape_K4=np.asarray(
                [(f.storey_m, f.bay_m, f.window_wide, f.window_high) for f in rows], np.float32
            ),
        )


def wall_colours(
    table: FacadeTable,
    day: Day,
    *,
    z: FloatMap,
    under: NDArray[np.uint32],
    height: FloatMap,
    facade: ByteMap,
    along: FloatMap,
    facing: FloatMap,
    shadow_top: FloatMap,
) -> NDArray[np.uint32]:
    """Packed colours (M,) of rays that hit a wall at height z; `under`: the colour above it."""
    storey, bay, wide, high = (table.shape_K4[:, k].take(facade) for k in range(4))
    floor, column = z / storey, along / bay
    up, across = floor - np.floor(floor), column - np.floor(column)
    glazed = (np.abs(up - np.float32(0.55)) < high / 2) & (
        np.abs(across - np.float32(0.5)) <= wide / 2
    )
    glazed &= height - z > 0.7  # the rim has no windows
    # Blinds and reflections: each window has a tone.
    pane = np.floor(floor) * np.float32(12.99) + np.floor(column) * np.float32(78.23)
    tone = np.float32(0.75) + np.float32(0.5) * (np.abs(np.sin(pane)) * np.float32(43.7) % 1)
    tone = np.where(glazed, tone, np.float32(0.96) + np.float32(0.06) * (up < 0.08))
    east, north, upward = day.toward_sun()
    turned = np.sin(facing) * np.float32(east) + np.cos(facing) * np.float32(north)
    direct = np.clip(turned / np.float32(max(upward, 0.35)), 0, 1.3) * (z > shadow_top)
    near_ground = np.float32(0.82) + np.float32(0.12) * np.minimum(z / 6, 1)
    sky_3, sun_3 = day.sky_light(), day.sun_light()
    # Sides of trees and cars have the colour of their top, darker downwards.
    is_building = facade > 0
    depth = np.float32(0.55) + np.float32(0.4) * np.clip(
        z / np.maximum(height, np.float32(0.1)), 0, 1
    )
    packed = np.zeros(z.shape, np.uint32)
    for c in range(3):
        base = np.where(glazed, table.glass_K3[:, c].take(facade), table.wall_K3[:, c].take(facade))
        lit = base * tone * (sky_3[c] * near_ground + sun_3[c] * direct)
        below = ((under >> np.uint32(8 * c)) & np.uint32(0xFF)).astype(np.float32) * depth
        value = np.clip(np.where(is_building, lit, below), 0, 255).astype(np.uint32)
        packed |= value << np.uint32(8 * c)
    return packed
