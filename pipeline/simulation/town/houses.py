"""A block of houses: lots with a house, a drive and a yard each."""

from math import cos, pi, sin

from pipeline.simulation.canvas import PAVED, Colour
from pipeline.simulation.palette import PAVING, pick_colour
from pipeline.simulation.town import grounds
from pipeline.simulation.town.buildings import BuildingPart, Roof, raise_part
from pipeline.simulation.town.plot import Plot


def fill_houses(plot: Plot) -> None:
    """Lots along the block's long sides, each with a house, a drive, a yard, perhaps a pool or a
    shed.
    """
    b, rng = plot.block, plot.rng
    along_p = b.size_p >= b.size_q
    length, depth = (b.size_p, b.size_q) if along_p else (b.size_q, b.size_p)
    rows = 2 if depth > 34 else 1
    lot = float(rng.uniform(13, 21))
    setback = float(rng.uniform(5, 8))
    drive = pick_colour(rng, PAVING)
    for row in range(rows):
        side = -1 if row == 0 else 1
        for k in range(int(length // lot)):
            where = (k + 0.5) * length / (length // lot) - length / 2 + float(rng.normal(0, 0.6))
            half_w, half_d = (
                float(rng.uniform(4.2, min(7.2, lot * 0.4))),
                float(rng.uniform(3.6, 5.4)),
            )
            off = side * (depth / 2 - setback - half_d) if rows == 2 else float(rng.normal(0, 2))
            if rng.random() < 0.06:
                continue
            p, q = (where, off) if along_p else (off, where)
            p, q = p + (b.p0 + b.p1) / 2, q + (b.q0 + b.q1) / 2
            x, y, angle = plot.at(p, q)
            angle += (0.0 if along_p else pi / 2) + float(rng.normal(0, 0.03))
            _drive(plot, x, y, angle, half_w, half_d, side if rows == 2 else -1, setback, drive)
            _house(plot, x, y, angle, half_w, half_d)
            if rng.random() < 0.10:
                px, py = plot.at(
                    *(
                        (where + b.p0 / 2 + b.p1 / 2, q - side * (half_d + 6))
                        if along_p
                        else (p - side * (half_d + 6), where + b.q0 / 2 + b.q1 / 2)
                    )
                )[:2]
                grounds.draw_pool(plot.canvas, rng, px, py, angle)
    plot.plant(1.0)


def _drive(
    plot: Plot,
    x: float,
    y: float,
    angle: float,
    half_w: float,
    half_d: float,
    side: int,
    setback: float,
    colour: Colour,
) -> None:
    reach = half_d + setback / 2 + 1
    u = half_w * float(plot.rng.uniform(0.3, 0.9))
    # The house's v axis runs along the block's depth, up to its sign.
    c, s = cos(angle), sin(angle)
    bx, by = x + c * u - s * side * reach, y + s * u + c * side * reach
    plot.canvas.box(bx, by, angle, 1.7, setback / 2 + 1.5, colour, cover=PAVED)
    if plot.rng.random() < 0.5:
        grounds.draw_car(plot.canvas, plot.rng, bx, by, angle + pi / 2)


def _house(plot: Plot, x: float, y: float, angle: float, half_w: float, half_d: float) -> None:
    rng = plot.rng
    colour = pick_colour(rng, plot.roofs, spread=9)
    eave = float(rng.choice([3.0, 5.6], p=[0.6, 0.4])) + float(rng.uniform(0, 0.5))
    kind = "hip" if rng.random() < 0.45 else "gable"
    walls = int(rng.choice(plot.house_walls))
    parts = [(0.0, 0.0, half_w, half_d)]
    if rng.random() < 0.55:  # a wing makes an L or a T
        u = float(rng.uniform(-0.6, 0.6)) * half_w
        parts.append((u, float(rng.choice([-1, 1])) * half_d * 0.7, half_d * 0.62, half_d * 0.95))
    for u, v, hu, hv in parts:
        c, s = cos(angle), sin(angle)
        roof = Roof(kind="hip" if kind == "hip" else "gable", colour=colour,
                    rise_m=min(hu, hv) * float(rng.uniform(0.45, 0.65)), seam_m=0.9)  # fmt: skip
        raise_part(
            plot.canvas,
            BuildingPart(
                x=x + c * u - s * v,
                y=y + s * u + c * v,
                angle=angle,
                half_u=hu,
                half_v=hv,
                eave_m=eave,
                roof=roof,
                facade=walls,
            ),
        )
