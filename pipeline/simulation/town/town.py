"""Procedural towns: a generator comes in, a World around one campus-like building goes out.

All towns share their palettes, so that colour alone does not tell two towns apart; a town's plan
does: the footprint and roof of its central building, the streets, and the buildings of its blocks.
"""

from math import cos, pi, sin

import numpy as np

from pipeline.simulation.canvas import GROUND, PAVED, Canvas
from pipeline.simulation.palette import GRASS, PAVING, TREES, pick_colour
from pipeline.simulation.town import grounds, landmark, streets
from pipeline.simulation.town.blocks import FILLERS
from pipeline.simulation.town.plot import Plot, neighbourhood_style
from pipeline.simulation.world import World

EXTENT_IN_RADII = 6.8
"""Side of the map in target radii: only the far corners of the first frame leave it."""
TEXELS_PER_RADIUS = 110
"""Map resolution for frames of 256 pixels: the last frame then has one map pixel per pixel."""


def make_town(rng: np.random.Generator, *, frame_pixels: int = 256) -> World:
    """A town with the detail of frames of `frame_pixels`; the plan is the same at every size."""
    radius_m = float(rng.uniform(27, 46))
    metres_per_pixel = radius_m / TEXELS_PER_RADIUS * 256 / frame_pixels
    return build_town(rng, radius_m, EXTENT_IN_RADII * radius_m, metres_per_pixel)


def build_town(
    rng: np.random.Generator, radius_m: float, extent_m: float, metres_per_pixel: float
) -> World:
    """A town of `extent_m` a side around a campus of `radius_m`."""
    # Separate streams: draws that depend on the map's resolution must not change the plan.
    plan, grain = rng.spawn(2)
    canvas = Canvas(
        extent_m=extent_m,
        metres_per_pixel=metres_per_pixel,
        ground=pick_colour(plan, GRASS),
        rng=plan,
    )
    grid = streets.plan_streets(plan, extent_m=canvas.extent_m, central_m=radius_m * 1.08)
    streets.paint_streets(canvas, grid, plan)
    roofs, house_walls, block_walls = neighbourhood_style(canvas, plan)
    leaves, density = pick_colour(plan, TREES), float(plan.gamma(3.0, 0.13))
    # Each town has its own mix of fillers: some are common, some absent.
    names = list(FILLERS)
    weights = plan.dirichlet(np.asarray([2.2, 1.0, 0.9, 0.5, 0.7, 0.7, 0.6, 0.3, 0.7]) * 0.9)
    half = canvas.extent_m / 2
    for block in grid.blocks():
        seed = plan.spawn(1)[0]
        plot = Plot(
            canvas=canvas,
            grid=grid,
            block=block,
            rng=seed,
            roofs=roofs,
            leaves=leaves,
            house_walls=house_walls,
            block_walls=block_walls,
            tree_density=density,
        )
        x, y = grid.to_world((block.p0 + block.p1) / 2, (block.q0 + block.q1) / 2)
        reach = (block.size_p + block.size_q) / 2
        if max(abs(x), abs(y)) > half + reach:
            continue
        if block.central:
            _build_campus(plot, radius_m)
        else:
            FILLERS[names[int(seed.choice(len(names), p=weights))]](plot)
    _add_street_details(canvas, grid, plan, leaves)
    return canvas.finish(target_radius_m=radius_m, rng=grain)


def _build_campus(plot: Plot, radius_m: float) -> None:
    """The central building and its grounds."""
    canvas, rng, b = plot.canvas, plot.rng, plot.block
    x, y, angle = plot.at(0, 0)
    paving = pick_colour(rng, PAVING)
    if rng.random() < 0.35:  # a plaza instead of a lawn
        canvas.box(
            x,
            y,
            angle,
            radius_m * float(rng.uniform(0.8, 1.1)),
            radius_m * float(rng.uniform(0.7, 1.1)),
            paving,
            cover=PAVED,
            corner_m=4,
        )
    for k in range(int(rng.integers(3, 8))):  # paths from the doors to the streets
        turn = (
            angle
            + float(rng.choice([0, pi / 2, pi, -pi / 2]))
            + float(rng.choice([0, 0, 0.5, -0.5]))
        )
        reach = radius_m * 1.6
        away = float(rng.uniform(-0.4, 0.4)) * radius_m
        grounds.draw_path(
            canvas,
            [
                (x - sin(turn) * away, y + cos(turn) * away),
                (
                    x - sin(turn) * away + cos(turn) * reach,
                    y + cos(turn) * away + sin(turn) * reach,
                ),
            ],
            float(rng.uniform(1.8, 4.0)) if k else 5.0,
            paving,
            cover=GROUND,
        )
    for side, edge in ((-1, b.q0), (1, b.q1)):
        room = abs(edge) - radius_m * 0.8
        if room > 9 and rng.random() < 0.5:
            px, py, turn = plot.at(0, edge - side * room / 2)
            grounds.draw_car_park(
                canvas, rng, px, py, turn, b.size_p / 2 * float(rng.uniform(0.4, 0.9)), room / 2 - 1
            )
    if rng.random() < 0.25:
        px, py = plot.spot(14)
        grounds.draw_water(
            canvas,
            rng,
            px,
            py,
            float(rng.uniform(0, pi)),
            float(rng.uniform(6, 12)),
            float(rng.uniform(4, 8)),
        )
    skew = float(rng.choice([0.0, 0.0, 0.0, pi / 4])) + float(rng.normal(0, 0.04))
    landmark.build_landmark(
        canvas, rng, angle=angle + skew + float(rng.choice([0, pi / 2])), radius_m=radius_m
    )
    plot.plant(1.2)


def _add_street_details(
    canvas: Canvas,
    grid: streets.StreetGrid,
    rng: np.random.Generator,
    leaves: tuple[float, float, float],
) -> None:
    """Cars on the roads and along the kerbs, rows of trees beside them."""
    half = canvas.extent_m / 2
    rows = float(rng.choice([0.0, 0.35, 0.8], p=[0.4, 0.35, 0.25]))
    for street, is_avenue in [(s, True) for s in grid.avenues] + [(s, False) for s in grid.crosses]:
        busy, parked = float(rng.uniform(0.02, 0.10)), float(rng.choice([0.0, 0.15, 0.5]))
        for along in np.arange(-1.5 * half, 1.5 * half, 6.5):
            draws = rng.random(6)
            if not street.start < along < street.end:
                continue

            def at(off: float, along: float = float(along), street: streets.Street = street,
                   is_avenue: bool = is_avenue) -> tuple[float, float, float]:  # fmt: skip
                p, q = (street.at + off, along) if is_avenue else (along, street.at + off)
                x, y = grid.to_world(p, q)
                return x, y, grid.turn_at(q) + (pi / 2 if is_avenue else 0.0)

            for side in (-1, 1):
                lane = side * street.width / 4
                if draws[0 if side < 0 else 1] < busy:
                    grounds.draw_car(canvas, rng, *at(lane))
                elif draws[2 if side < 0 else 3] < parked and street.width >= 8:
                    grounds.draw_car(canvas, rng, *at(side * (street.width / 2 - 1.2)))
                if draws[4 if side < 0 else 5] < rows:
                    x, y, _ = at(side * (street.width / 2 + 3.4))
                    grounds.scatter_trees(
                        canvas, rng, [(x, y)], leaves, radius=(1.8, 3.4), on=(GROUND, PAVED)
                    )
