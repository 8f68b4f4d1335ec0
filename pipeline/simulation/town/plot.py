"""A block of a town as fillers see it: canvas, position in the grid, style of the neighbourhood."""

from dataclasses import dataclass

import numpy as np

from pipeline.simulation.canvas import Canvas, Colour
from pipeline.simulation.palette import PITCHED_ROOFS, pick_colour, random_facade, scale_brightness
from pipeline.simulation.town import grounds
from pipeline.simulation.town.buildings import (
    BuildingPart,
    Roof,
    add_facade,
    furnish_flat_roof,
    raise_part,
)
from pipeline.simulation.town.streets import Block, StreetGrid


@dataclass(frozen=True, kw_only=True)
class Plot:
    """A block to fill, with the style of its town."""

    canvas: Canvas
    grid: StreetGrid
    block: Block
    rng: np.random.Generator
    roofs: tuple[Colour, ...]
    """The few roof colours of this neighbourhood's houses."""
    leaves: Colour
    house_walls: tuple[int, ...]
    """Facade numbers for houses."""
    block_walls: tuple[int, ...]
    """Facade numbers for larger buildings."""
    tree_density: float
    """Trees per 100 square metres of open ground."""

    def at(self, p: float, q: float) -> tuple[float, float, float]:
        """(x, y, angle of the p axis) in the map at a point of the grid."""
        x, y = self.grid.to_world(p, q)
        return x, y, self.grid.turn_at(q)

    def spot(self, margin: float = 2.0) -> tuple[float, float]:
        """A random point of the block, in the map."""
        b = self.block
        p = self.rng.uniform(b.p0 + margin, max(b.p0 + margin + 0.1, b.p1 - margin))
        q = self.rng.uniform(b.q0 + margin, max(b.q0 + margin + 0.1, b.q1 - margin))
        return self.grid.to_world(float(p), float(q))

    def plant(self, density: float = 1.0, *, radius: tuple[float, float] = (1.8, 4.2)) -> None:
        """Plant trees over the open ground of the block."""
        count = self.rng.poisson(
            self.block.size_p * self.block.size_q / 100 * self.tree_density * density
        )
        spots = [self.spot() for _ in range(min(400, int(count)))]
        grounds.scatter_trees(self.canvas, self.rng, spots, self.leaves, radius=radius)

    def box(
        self,
        p: float,
        q: float,
        hp: float,
        hq: float,
        colour: Colour,
        *,
        cover: int,
        grass: float = 0.0,
    ) -> None:
        x, y, angle = self.at(p, q)
        self.canvas.box(x, y, angle, hp, hq, colour, cover=cover, grass=grass)

    def flat_building(
        self, p: float, q: float, hp: float, hq: float, eave: float, colour: Colour
    ) -> None:
        x, y, angle = self.at(p, q)
        rng = self.rng
        part = BuildingPart(x=x, y=y, angle=angle, half_u=hp, half_v=hq, eave_m=eave,
                    roof=Roof(kind="flat", colour=colour, seam_m=float(rng.choice([0.0, 5.0])),
                              parapet=scale_brightness(colour, float(rng.uniform(0.85, 1.2)))),
                    facade=int(rng.choice(self.block_walls)))  # fmt: skip
        raise_part(self.canvas, part)
        furnish_flat_roof(self.canvas, part, rng, richness=0.7)


def neighbourhood_style(
    canvas: Canvas, rng: np.random.Generator
) -> tuple[tuple[Colour, ...], tuple[int, ...], tuple[int, ...]]:
    """(roof colours, house facades, block facades) that all plots of a town share."""
    roofs = tuple(pick_colour(rng, PITCHED_ROOFS) for _ in range(int(rng.integers(2, 5))))
    house_walls = tuple(add_facade(canvas, random_facade(rng, kind="house")) for _ in range(3))
    block_walls = tuple(add_facade(canvas, random_facade(rng, kind="block")) for _ in range(3))
    return roofs, house_walls, (*block_walls, add_facade(canvas, random_facade(rng, kind="hall")))
