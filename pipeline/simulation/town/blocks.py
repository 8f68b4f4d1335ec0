"""Fillers of blocks: houses, slabs, shops, car parks, parks, sports, sheds, woods, old centres.

Each filler takes a `Plot`, draws from its generator and paints on its canvas.
"""

from collections.abc import Callable
from itertools import pairwise
from math import pi

import numpy as np

from pipeline.simulation.canvas import GROUND, PAVED
from pipeline.simulation.palette import ASPHALT, EARTH, FLAT_ROOFS, METAL_ROOFS, PAVING, pick_colour
from pipeline.simulation.town import grounds, sports
from pipeline.simulation.town.buildings import BuildingPart, Roof, raise_part
from pipeline.simulation.town.houses import fill_houses
from pipeline.simulation.town.plot import Plot


def fill_slabs(plot: Plot) -> None:
    """Long blocks of flats in rows on a lawn, with a strip of parking."""
    b, rng = plot.block.inset(5), plot.rng
    roof, pitched = pick_colour(rng, FLAT_ROOFS), rng.random() < 0.4
    half_deep, gap = float(rng.uniform(5.5, 7.5)), float(rng.uniform(11, 17))
    eave, tiles = float(rng.uniform(8, 17)), pick_colour(rng, plot.roofs)
    rows = max(1, int((b.size_q + gap) // (2 * half_deep + gap)))
    for row in range(rows):
        q = b.q0 + (row + 0.5) * b.size_q / rows
        cut = float(rng.uniform(0.7, 1.0))
        hp = b.size_p / 2 * cut
        p = (b.p0 + b.p1) / 2 + (b.size_p / 2 - hp) * float(rng.choice([-1, 1]))
        plot.box(p, q + half_deep + 3, hp, 1.0, (168, 162, 152), cover=PAVED)
        if pitched:
            x, y, angle = plot.at(p, q)
            raise_part(
                plot.canvas,
                BuildingPart(
                    x=x,
                    y=y,
                    angle=angle,
                    half_u=hp,
                    half_v=half_deep,
                    eave_m=eave,
                    roof=Roof(kind="hip", colour=tiles, rise_m=3.6, seam_m=1.1),
                    facade=int(rng.choice(plot.block_walls)),
                ),
            )
        else:
            plot.flat_building(p, q, hp, half_deep, eave, roof)
        if row and rng.random() < 0.5:
            x, y, angle = plot.at(p, q - half_deep - gap / 2)
            grounds.draw_car_park(plot.canvas, rng, x, y, angle, hp * 0.8, min(4.4, gap / 2 - 1))
    plot.plant(0.8)


def fill_shops(plot: Plot) -> None:
    """One or two low boxes with their car park."""
    b, rng = plot.block.inset(3), plot.rng
    split = float(rng.uniform(0.38, 0.6))
    mid_q = b.q0 + b.size_q * split
    p_mid = (b.p0 + b.p1) / 2
    x, y, angle = plot.at(p_mid, (mid_q + b.q1) / 2)
    grounds.draw_car_park(plot.canvas, rng, x, y, angle, b.size_p / 2, (b.q1 - mid_q) / 2)
    count = int(rng.integers(1, 4))
    edges = np.linspace(b.p0, b.p1, count + 1)
    for low, high in pairwise(edges):
        depth = (mid_q - b.q0 - 3) * float(rng.uniform(0.75, 1.0))
        plot.flat_building(
            float(low + high) / 2,
            b.q0 + depth / 2,
            float(high - low) / 2 - float(rng.uniform(0, 2.5)),
            depth / 2,
            float(rng.uniform(5, 9)),
            pick_colour(rng, FLAT_ROOFS),
        )
    plot.plant(0.25)


def fill_parking(plot: Plot) -> None:
    """A car park."""
    b = plot.block.inset(2)
    x, y, angle = plot.at((b.p0 + b.p1) / 2, (b.q0 + b.q1) / 2)
    turn = plot.rng.random() < 0.5
    half = (b.size_q / 2, b.size_p / 2) if turn else (b.size_p / 2, b.size_q / 2)
    grounds.draw_car_park(plot.canvas, plot.rng, x, y, angle + (pi / 2 if turn else 0), *half)
    plot.plant(0.2)


def fill_park(plot: Plot) -> None:
    """Lawn, winding paths, perhaps a pond, and trees."""
    b, rng = plot.block, plot.rng
    if rng.random() < 0.5:
        x, y = plot.spot(12)
        grounds.draw_water(
            plot.canvas,
            rng,
            x,
            y,
            float(rng.uniform(0, pi)),
            float(rng.uniform(8, 20)),
            float(rng.uniform(6, 13)),
        )
    gravel = pick_colour(rng, PAVING)
    for _ in range(int(rng.integers(2, 5))):
        start, end, via = plot.spot(0), plot.spot(0), plot.spot(6)
        bend = [((1 - t) ** 2 * start[0] + 2 * t * (1 - t) * via[0] + t * t * end[0],
                 (1 - t) ** 2 * start[1] + 2 * t * (1 - t) * via[1] + t * t * end[1])
                for t in np.linspace(0, 1, 9)]  # fmt: skip
        grounds.draw_path(plot.canvas, bend, float(rng.uniform(1.6, 3.0)), gravel)
    plot.plant(float(rng.uniform(0.8, 2.2)), radius=(2.2, 5.4))
    if rng.random() < 0.3 and b.size_p > 30:
        x, y = plot.spot(10)
        plot.canvas.disc(x, y, float(rng.uniform(4, 8)), gravel, cover=PAVED)


def fill_sports(plot: Plot) -> None:
    """A pitch, tennis courts or a baseball diamond, as the block allows."""
    b, rng = plot.block.inset(4), plot.rng
    p, q = (b.p0 + b.p1) / 2, (b.q0 + b.q1) / 2
    x, y, angle = plot.at(p, q)
    if b.size_q > b.size_p:
        angle += pi / 2
    long, short = max(b.size_p, b.size_q) / 2, min(b.size_p, b.size_q) / 2
    cut = rng.random()
    if cut < 0.5 and short > 16:
        sports.draw_pitch(plot.canvas, rng, x, y, angle, min(long, 54), min(short, 36))
    elif cut < 0.7 and short > 20:
        sports.draw_diamond(
            plot.canvas,
            rng,
            x,
            y,
            angle + float(rng.choice([0, pi / 2, pi, -pi / 2])),
            min(short, 42),
        )
    else:
        sports.draw_courts(plot.canvas, rng, x, y, angle, min(long, 38), min(short, 19))
    plot.plant(0.5)


def fill_sheds(plot: Plot) -> None:
    """Metal halls, tanks and yards on concrete or bare earth."""
    b, rng = plot.block.inset(3), plot.rng
    ground = pick_colour(rng, EARTH) if rng.random() < 0.5 else pick_colour(rng, ASPHALT)
    plot.box((b.p0 + b.p1) / 2, (b.q0 + b.q1) / 2, b.size_p / 2, b.size_q / 2, ground, cover=PAVED)
    columns, rows = max(1, int(b.size_p // 34)), max(1, int(b.size_q // 28))
    for i in range(columns):
        for j in range(rows):
            hp, hq = b.size_p / columns / 2, b.size_q / rows / 2
            x, y, angle = plot.at(b.p0 + (2 * i + 1) * hp, b.q0 + (2 * j + 1) * hq)
            cut = rng.random()
            if cut < 0.25:
                radius = min(hp, hq) * float(rng.uniform(0.5, 0.85))
                tank = Roof(kind="dome", colour=pick_colour(rng, METAL_ROOFS), rise_m=1.2)
                raise_part(
                    plot.canvas,
                    BuildingPart(
                        x=x,
                        y=y,
                        angle=angle,
                        half_u=radius,
                        half_v=radius,
                        eave_m=float(rng.uniform(5, 11)),
                        roof=tank,
                        round=True,
                        facade=int(rng.choice(plot.house_walls)),
                    ),
                )
            elif cut < 0.88:
                hu, hv = hp * float(rng.uniform(0.6, 0.92)), hq * float(rng.uniform(0.5, 0.85))
                kind = rng.random()
                roof = Roof(
                    kind="gable" if kind < 0.5 else "sawtooth" if kind < 0.75 else "barrel",
                    colour=pick_colour(rng, METAL_ROOFS),
                    rise_m=min(3.0, min(hu, hv) * 0.3),
                    seam_m=1.8,
                )
                raise_part(
                    plot.canvas,
                    BuildingPart(
                        x=x,
                        y=y,
                        angle=angle,
                        half_u=hu,
                        half_v=hv,
                        eave_m=float(rng.uniform(5, 9)),
                        roof=roof,
                        facade=int(rng.choice(plot.block_walls)),
                    ),
                )
    for _ in range(int(rng.integers(3, 12))):
        x, y = plot.spot(6)
        grounds.draw_car(plot.canvas, rng, x, y, float(rng.uniform(0, pi)))


def fill_woods(plot: Plot) -> None:
    """Trees, close together, with a clearing or two."""
    plot.plant(min(5.0, 1.6 / max(0.2, plot.tree_density)), radius=(2.4, 5.0))


def fill_old_centre(plot: Plot) -> None:
    """Narrow houses wall to wall around courtyards."""
    b, rng = plot.block.inset(1), plot.rng
    plot.box(
        (b.p0 + b.p1) / 2,
        (b.q0 + b.q1) / 2,
        b.size_p / 2,
        b.size_q / 2,
        pick_colour(rng, PAVING),
        cover=PAVED,
    )
    deep = float(rng.uniform(9, 13))
    for low, high, fixed, along_p in (
        (b.p0, b.p1, b.q0 + deep / 2, True),
        (b.p0, b.p1, b.q1 - deep / 2, True),
        (b.q0 + deep, b.q1 - deep, b.p0 + deep / 2, False),
        (b.q0 + deep, b.q1 - deep, b.p1 - deep / 2, False),
    ):
        at = low
        while at < high - 4:
            wide = min(float(rng.uniform(7, 18)), high - at)
            p, q = (at + wide / 2, fixed) if along_p else (fixed, at + wide / 2)
            at += wide
            if rng.random() < 0.06:
                continue
            depth = deep / 2 * float(rng.uniform(0.85, 1.1))
            eave = float(rng.uniform(6, 14))
            if rng.random() < 0.55:
                x, y, angle = plot.at(p, q)
                hu, hv = (wide / 2, depth) if along_p else (depth, wide / 2)
                # Ridges follow the street: the long side is along it.
                roof = Roof(
                    kind="gable",
                    colour=pick_colour(rng, plot.roofs, spread=9),
                    rise_m=min(hu, hv) * 0.6,
                    seam_m=0.9,
                )
                raise_part(
                    plot.canvas,
                    BuildingPart(
                        x=x,
                        y=y,
                        angle=angle,
                        half_u=hu,
                        half_v=hv,
                        eave_m=eave,
                        roof=roof,
                        facade=int(rng.choice(plot.block_walls)),
                    ),
                )
            else:
                hp, hq = (wide / 2, depth) if along_p else (depth, wide / 2)
                plot.flat_building(p, q, hp, hq, eave, pick_colour(rng, FLAT_ROOFS))
    inner = b.inset(deep + 2)
    if inner.size_p > 10 and inner.size_q > 10:
        plot.box(
            (b.p0 + b.p1) / 2,
            (b.q0 + b.q1) / 2,
            inner.size_p / 2,
            inner.size_q / 2,
            (98, 112, 70),
            cover=GROUND,
            grass=0.9,
        )
        plot.plant(0.6)


FILLERS: dict[str, Callable[[Plot], None]] = {
    "houses": fill_houses,
    "slabs": fill_slabs,
    "shops": fill_shops,
    "parking": fill_parking,
    "park": fill_park,
    "sports": fill_sports,
    "sheds": fill_sheds,
    "woods": fill_woods,
    "old centre": fill_old_centre,
}
