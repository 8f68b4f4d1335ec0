"""The streets of a town: a grid at any angle, bent or broken, and the blocks between them.

Grid coordinates: p across the avenues and q along them, metres, (0, 0) the middle of the map. A
bend shifts p by a sine of q, so that avenues wind and the blocks between them follow.

Letters: H, W pixels of the map.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import atan, cos, hypot, pi, sin

import numpy as np

from pipeline.simulation.canvas import PAVED, ROAD, Canvas, Colour
from pipeline.simulation.palette import ASPHALT, PAVING, pick_colour
from pipeline.simulation.world import FloatMap


@dataclass(frozen=True, kw_only=True)
class Street:
    """One line of the grid: position, width, and the cross lines of its ends. Metres."""

    at: float
    width: float
    start: float
    end: float


@dataclass(frozen=True, kw_only=True)
class Block:
    """The area between four streets, kerb to kerb, in grid coordinates. Metres."""

    p0: float
    p1: float
    q0: float
    q1: float
    central: bool = False

    @property
    def size_p(self) -> float:
        return self.p1 - self.p0

    @property
    def size_q(self) -> float:
        return self.q1 - self.q0

    def inset(self, margin: float) -> "Block":
        """The block without a strip along its edges."""
        return Block(
            p0=self.p0 + margin,
            p1=self.p1 - margin,
            q0=self.q0 + margin,
            q1=self.q1 - margin,
            central=self.central,
        )


@dataclass(frozen=True, kw_only=True)
class StreetGrid:
    """All streets of a town, and the conversion between grid and map coordinates."""

    angle: float
    bend_m: float
    bend_length_m: float
    bend_phase: float
    avenues: tuple[Street, ...]
    """Lines of constant p."""
    crosses: tuple[Street, ...]
    """Lines of constant q."""

    def to_world(self, p: float, q: float) -> tuple[float, float]:
        """Map coordinates (x, y) of a point of the grid."""
        along = p + self.bend_m * sin(q / self.bend_length_m + self.bend_phase)
        c, s = cos(self.angle), sin(self.angle)
        return c * along - s * q, s * along + c * q

    def turn_at(self, q: float) -> float:
        """Angle of the p axis for blocks at q, radians counter-clockwise from east."""
        slope = self.bend_m / self.bend_length_m * cos(q / self.bend_length_m + self.bend_phase)
        return self.angle - atan(slope)

    def fields(self, canvas: Canvas) -> tuple[FloatMap, FloatMap]:
        """(p_HW, q_HW): the grid coordinates of every pixel."""
        c, s = np.float32(cos(self.angle)), np.float32(sin(self.angle))
        x, y = canvas.x_W[None, :], canvas.y_H[:, None]
        q: FloatMap = c * y - s * x
        bend = np.float32(self.bend_m) * np.sin(
            q / np.float32(self.bend_length_m) + np.float32(self.bend_phase)
        )
        p: FloatMap = c * x + s * y - bend
        return p, q

    def blocks(self) -> list[Block]:
        """The blocks between the streets, the central block first."""
        found = []
        for left, right in pairwise(self.avenues):
            for low, high in pairwise(self.crosses):
                found.append(
                    Block(
                        p0=left.at + left.width / 2, p1=right.at - right.width / 2,
                        q0=low.at + low.width / 2, q1=high.at - high.width / 2,
                        central=left.at < 0 < right.at and low.at < 0 < high.at,
                    )
                )  # fmt: skip
        return sorted(found, key=lambda block: not block.central)


def plan_streets(rng: np.random.Generator, *, extent_m: float, central_m: float) -> StreetGrid:
    """A random street grid whose central block is at least 2 * `central_m` wide."""
    reach = extent_m / 2 * hypot(1, 1)
    bent = rng.random() < 0.35
    return StreetGrid(
        angle=float(rng.uniform(-pi / 2, pi / 2)),
        bend_m=float(rng.uniform(6, 16)) if bent else 0.0,
        bend_length_m=float(rng.uniform(38, 70)),
        bend_phase=float(rng.uniform(0, 2 * pi)),
        avenues=_plan_lines(rng, reach, central_m, spacing=(48, 105)),
        crosses=_plan_lines(rng, reach, central_m, spacing=(44, 95)),
    )


def _plan_lines(
    rng: np.random.Generator, reach: float, central_m: float, *, spacing: tuple[float, float]
) -> tuple[Street, ...]:
    low, high = -central_m - float(rng.uniform(4, 22)), central_m + float(rng.uniform(4, 22))
    at = [low, high]
    while at[0] > -reach:
        at.insert(0, at[0] - float(rng.uniform(*spacing)))
    while at[-1] < reach:
        at.append(at[-1] + float(rng.uniform(*spacing)))
    streets = []
    for line in at:
        width = float(rng.choice([6.5, 8.0, 10.0, 14.0], p=[0.3, 0.35, 0.25, 0.1]))
        cut = rng.random()
        # A street may end at the central block's line: not every crossing has four arms.
        start = low if cut < 0.12 else -2 * reach
        end = high if cut > 0.88 else 2 * reach
        streets.append(Street(at=line, width=width, start=start, end=end))
    return tuple(streets)


def paint_streets(canvas: Canvas, grid: StreetGrid, rng: np.random.Generator) -> None:
    """Paint pavements, asphalt, markings and crossings."""
    p_HW, q_HW = grid.fields(canvas)
    asphalt, kerb = pick_colour(rng, ASPHALT), pick_colour(rng, PAVING)
    walk_m = float(rng.choice([0.0, 1.6, 2.4], p=[0.15, 0.45, 0.4]))
    painted: Colour = (226, 224, 214)
    middle: Colour = (214, 184, 92) if rng.random() < 0.5 else painted
    lines = [(street, p_HW, q_HW) for street in grid.avenues] + [
        (street, q_HW, p_HW) for street in grid.crosses
    ]
    for colour, extra, cover in ((kerb, walk_m, PAVED), (asphalt, 0.0, ROAD)):
        if cover == PAVED and walk_m == 0.0:
            continue
        inside_HW = np.full_like(p_HW, -1e6)
        for street, across_HW, along_HW in lines:
            half = street.width / 2 + extra
            inside = np.minimum(np.float32(half) - np.abs(across_HW - np.float32(street.at)),
                                np.minimum(along_HW - np.float32(street.start - extra),
                                           np.float32(street.end + extra) - along_HW))  # fmt: skip
            np.maximum(inside_HW, inside, out=inside_HW)
        _paint_mask(canvas, inside_HW, colour, cover)
    mark = max(0.16, 0.30 * canvas.metres_per_pixel)
    for index, (street, across_HW, along_HW) in enumerate(lines):
        others = grid.crosses if index < len(grid.avenues) else grid.avenues
        off_HW = np.abs(across_HW - np.float32(street.at))
        near = off_HW < street.width / 2
        rows, cols = np.nonzero(near & (along_HW > street.start) & (along_HW < street.end))
        if rows.size == 0:
            continue
        off, along = off_HW[rows, cols], along_HW[rows, cols]
        gap = np.min(
            [np.abs(along - np.float32(o.at)) - np.float32(o.width / 2) for o in others], axis=0
        )
        soft = np.float32(1 / canvas.metres_per_pixel)
        strength = np.zeros_like(off)
        if street.width >= 8:
            dashed = street.width >= 14
            drawn = np.clip((mark - off) * soft + 0.5, 0, 1) * (gap > 3)
            strength = drawn * (np.mod(along, 9) < 4.5) if dashed else drawn
            if dashed:
                lanes = np.abs(off - np.float32(street.width / 4))
                strength = np.maximum(
                    strength,
                    np.clip((mark - lanes) * soft + 0.5, 0, 1) * (gap > 3) * (np.mod(along, 8) < 3),
                )
        crossing = (gap > 0.6) & (gap < 3.2) & (np.mod(off + 0.3, 1.3) < 0.65) & (street.width >= 8)
        worn = 0.62 + 0.15 * canvas.lumps_HW[rows, cols]
        amount = np.maximum(strength, crossing * 0.8)[:, None] * worn[:, None]
        tint = np.where(
            crossing[:, None], np.asarray(painted, np.float32), np.asarray(middle, np.float32)
        )
        under = canvas.colour_HW3[rows, cols]
        # Tyres leave a darker band in each lane.
        under *= (1 - 0.05 * np.exp(-(((off - street.width / 4) / 0.9) ** 2)))[:, None]
        canvas.colour_HW3[rows, cols] = under + amount * (tint - under)


def _paint_mask(canvas: Canvas, inside_HW: FloatMap, colour: Colour, cover: int) -> None:
    coverage_HW = canvas.coverage(inside_HW)
    canvas.colour_HW3 += coverage_HW[..., None] * (
        np.asarray(colour, np.float32) - canvas.colour_HW3
    )
    canvas.grass_HW *= 1 - coverage_HW
    canvas.cover_HW[coverage_HW > 0.5] = cover
