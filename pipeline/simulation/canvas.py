"""The canvas of a town: colours, heights and vegetation of a square map, painted stamp by stamp.

A stamp is a small window of the map in the coordinates of the object drawn there: u metres along
it, v across it. So a house, a car and a tennis court are each a few lines of arithmetic, at any
angle, at any resolution.

Letters: H, W pixels of the map; h, w pixels of a stamp's window; 3 red, green, blue.
"""

from dataclasses import dataclass
from math import ceil, cos, sin

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.world import Facade, FloatMap, World

Colour = tuple[float, float, float]

GROUND, ROAD, BUILDING, PAVED, WATER = range(5)
"""Cover of a pixel: decides where trees and cars may be."""


@dataclass(frozen=True, kw_only=True)
class Stamp:
    """A window of the map (`rows`, `cols`), with its pixels' coordinates in the object's frame."""

    rows: slice
    cols: slice
    u_hw: FloatMap
    v_hw: FloatMap
    angle: float
    """Radians, counter-clockwise from east to the u axis."""


class Canvas:
    """Maps being drawn, alike at every resolution; `finish` makes a World of them."""

    def __init__(
        self, *, extent_m: float, metres_per_pixel: float, ground: Colour, rng: np.random.Generator
    ) -> None:
        self.pixels = max(8, round(extent_m / metres_per_pixel))
        self.metres_per_pixel = extent_m / self.pixels
        self.extent_m = extent_m
        side = (self.pixels, self.pixels)
        self.colour_HW3: FloatMap = np.empty((*side, 3), np.float32)
        self.colour_HW3[:] = ground
        self.height_HW: FloatMap = np.zeros(side, np.float32)
        self.grass_HW: FloatMap = np.ones(side, np.float32)
        self.trees_HW: FloatMap = np.zeros(side, np.float32)
        self.cover_HW: NDArray[np.uint8] = np.full(side, GROUND, np.uint8)
        self.facade_HW: NDArray[np.uint8] = np.zeros(side, np.uint8)
        self.along_HW: FloatMap = np.zeros(side, np.float32)
        self.facing_HW: FloatMap = np.zeros(side, np.float32)
        self.facades: list[Facade] = []
        axis = (np.arange(self.pixels, dtype=np.float32) + 0.5) * np.float32(self.metres_per_pixel)
        self.x_W: FloatMap = axis - np.float32(extent_m / 2)
        self.y_H: FloatMap = np.float32(extent_m / 2) - axis
        self.lumps_HW = self.noise(rng, cell_m=1.6)
        """Noise at the scale of a branch or a stain, about -1 to 1."""
        self.patches_HW = self.noise(rng, cell_m=9.0)
        """Noise at the scale of a worn lawn, about -1 to 1."""

    def noise(self, rng: np.random.Generator, *, cell_m: float) -> FloatMap:
        """Smooth noise with features of `cell_m` metres, the same at every resolution."""
        cells = max(2, ceil(self.extent_m / cell_m))
        lattice = rng.standard_normal((cells + 1, cells + 1)).astype(np.float32)
        at = np.linspace(0, cells, self.pixels, dtype=np.float32)
        low = np.minimum(at.astype(np.int32), cells - 1)
        blend = at - low
        blend = blend * blend * (3 - 2 * blend)
        # No matrix product: its last bit may depend on the number of threads.
        across = lattice[:, low] + blend * (lattice[:, low + 1] - lattice[:, low])
        field = across[low] + blend[:, None] * (across[low + 1] - across[low])
        smooth: FloatMap = np.clip(field * np.float32(0.8), -1.5, 1.5)
        return smooth

    def stamp(self, x: float, y: float, angle: float, half_u: float, half_v: float) -> Stamp | None:
        """The window around a box of half sizes (metres) at (x, y); None if it is off the map."""
        c, s = cos(angle), sin(angle)
        reach_x = abs(c) * half_u + abs(s) * half_v
        reach_y = abs(s) * half_u + abs(c) * half_v
        mpp, half = self.metres_per_pixel, self.extent_m / 2
        left = max(0, int((x - reach_x + half) / mpp) - 1)
        right = min(self.pixels, int((x + reach_x + half) / mpp) + 2)
        top = max(0, int((half - y - reach_y) / mpp) - 1)
        bottom = min(self.pixels, int((half - y + reach_y) / mpp) + 2)
        if left >= right or top >= bottom:
            return None
        dx = self.x_W[left:right] - np.float32(x)
        dy = (self.y_H[top:bottom] - np.float32(y))[:, None]
        c32, s32 = np.float32(c), np.float32(s)
        return Stamp(
            rows=slice(top, bottom),
            cols=slice(left, right),
            u_hw=c32 * dx + s32 * dy,
            v_hw=c32 * dy - s32 * dx,
            angle=angle,
        )

    def coverage(self, inside_m_hw: FloatMap) -> FloatMap:
        """Fraction of each pixel in a shape, by its signed distance (metres, positive inside)."""
        covered: FloatMap = np.clip(
            inside_m_hw * np.float32(1 / self.metres_per_pixel) + np.float32(0.5), 0, 1
        )
        return covered

    def paint(
        self,
        stamp: Stamp,
        coverage_hw: FloatMap,
        colour: Colour | FloatMap,
        *,
        cover: int | None = None,
        grass: float = 0.0,
    ) -> None:
        """Blend a colour over the ground by its coverage; `cover` sets the pixels' cover."""
        at = (stamp.rows, stamp.cols)
        under = self.colour_HW3[at]
        under += coverage_hw[..., None] * (np.asarray(colour, np.float32) - under)
        lawn = self.grass_HW[at]
        lawn += coverage_hw * (np.float32(grass) - lawn)
        if cover is not None:
            self.cover_HW[at][coverage_hw > 0.5] = cover

    def box(
        self,
        x: float,
        y: float,
        angle: float,
        half_u: float,
        half_v: float,
        colour: Colour,
        *,
        cover: int | None = None,
        grass: float = 0.0,
        opacity: float = 1.0,
        corner_m: float = 0.0,
    ) -> None:
        """Paint a flat rectangle with antialiased edges and corners rounded by `corner_m`."""
        stamp = self.stamp(x, y, angle, half_u, half_v)
        if stamp is None:
            return
        du, dv = np.abs(stamp.u_hw) - (half_u - corner_m), np.abs(stamp.v_hw) - (half_v - corner_m)
        if corner_m > 0:
            outside = (
                np.hypot(np.maximum(du, 0), np.maximum(dv, 0))
                + np.minimum(np.maximum(du, dv), 0)
                - corner_m
            )
        else:
            outside = np.maximum(du, dv)
        self.paint(
            stamp, self.coverage(-outside) * np.float32(opacity), colour, cover=cover, grass=grass
        )

    def disc(
        self,
        x: float,
        y: float,
        radius: float,
        colour: Colour,
        *,
        cover: int | None = None,
        grass: float = 0.0,
        ring_m: float | None = None,
    ) -> None:
        """Paint a disc, or a ring of width `ring_m` inside its edge."""
        stamp = self.stamp(x, y, 0.0, radius, radius)
        if stamp is None:
            return
        inside = np.float32(radius) - np.hypot(stamp.u_hw, stamp.v_hw)
        if ring_m is not None:
            inside = np.minimum(inside, np.float32(ring_m) - inside)
        self.paint(stamp, self.coverage(inside), colour, cover=cover, grass=grass)

    def covered_by(self, x: float, y: float) -> int | None:
        """Cover of the pixel at (x, y); None off the map."""
        col, row = self.pixel_of(x, y)
        if not (0 <= col < self.pixels and 0 <= row < self.pixels):
            return None
        return int(self.cover_HW[row, col])

    def pixel_of(self, x: float, y: float) -> tuple[int, int]:
        """(column, row) of the pixel at (x, y), which may be off the map."""
        half = self.extent_m / 2
        return int((x + half) // self.metres_per_pixel), int((half - y) // self.metres_per_pixel)

    def finish(self, *, target_radius_m: float, rng: np.random.Generator) -> World:
        """The World drawn so far, with the grain of its surfaces."""
        grain = rng.standard_normal(self.height_HW.shape, dtype=np.float32) * np.float32(0.035)
        grain += self.lumps_HW * np.float32(0.03) + self.patches_HW * np.float32(0.03)
        grain += self.grass_HW * (
            self.lumps_HW * np.float32(0.05) + self.patches_HW * np.float32(0.05)
        )
        colour = self.colour_HW3 * (1 + grain)[..., None]
        # Worn lawn is more yellow, not only brighter.
        worn = np.maximum(self.patches_HW, 0) * self.grass_HW
        colour[..., 0] += 9 * worn
        colour[..., 2] -= 4 * worn
        return World(
            texture_HW3=np.clip(colour, 0, 255).astype(np.uint8),
            height_HW=self.height_HW,
            metres_per_pixel=self.metres_per_pixel,
            target_radius_m=target_radius_m,
            grass_HW=(self.grass_HW * 255).astype(np.uint8),
            trees_HW=(self.trees_HW * 255).astype(np.uint8),
            facade_HW=self.facade_HW,
            along_HW=self.along_HW,
            facing_HW=self.facing_HW,
            facades_K=tuple(self.facades),
        )
