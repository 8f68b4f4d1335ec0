"""Grounds between buildings: trees, cars, car parks, paths, pools and ponds.

Letters: h, w pixels of a stamp's window; 3 red, green, blue.
"""

from itertools import pairwise
from math import cos, hypot, pi, sin

import numpy as np

from pipeline.simulation.canvas import GROUND, PAVED, ROAD, WATER, Canvas, Colour
from pipeline.simulation.palette import ASPHALT, CARS, WHITE, pick_colour, scale_brightness
from pipeline.simulation.palette import WATER_COLOURS as WATERS


def draw_tree(
    canvas: Canvas, rng: np.random.Generator, x: float, y: float, radius: float, colour: Colour
) -> None:
    """A lumpy crown over all lower surfaces; its leaves are deciduous unless it is a conifer."""
    conifer = rng.random() < 0.2
    height = radius * float(rng.uniform(1.5, 2.3)) * (1.25 if conifer else 1.0)
    stamp = canvas.stamp(x, y, 0.0, radius, radius)
    if stamp is None:
        return
    at = (stamp.rows, stamp.cols)
    lumps = canvas.lumps_HW[at]
    reach = np.hypot(stamp.u_hw, stamp.v_hw) * np.float32(1 / radius) * (1 + 0.30 * lumps)
    crown = 1 - reach if conifer else np.sqrt(np.maximum(0, 1 - reach * reach))
    top = np.float32(height) * (np.float32(0.35) + np.float32(0.65) * crown * (1 + 0.30 * lumps))
    grown = (reach < 1) & (top > canvas.height_HW[at])
    canvas.height_HW[at][grown] = top[grown]
    tone = (0.82 + 0.24 * crown + 0.24 * lumps)[..., None].astype(np.float32)
    leaf = (
        scale_brightness(colour, 0.78)
        if conifer
        else scale_brightness(colour, float(rng.uniform(0.85, 1.15)))
    )
    canvas.colour_HW3[at][grown] = (tone * np.asarray(leaf, np.float32))[grown]
    canvas.grass_HW[at][grown] = 0
    canvas.trees_HW[at][grown] = 0.08 if conifer else float(rng.uniform(0.75, 1.0))
    canvas.facade_HW[at][grown] = 0


def scatter_trees(
    canvas: Canvas,
    rng: np.random.Generator,
    spots: list[tuple[float, float]],
    colour: Colour,
    *,
    radius: tuple[float, float] = (1.8, 4.2),
    on: tuple[int, ...] = (GROUND,),
) -> None:
    """Plant trees at the spots (x, y) whose cover allows it."""
    for x, y in spots:
        r = float(rng.uniform(*radius))
        if canvas.covered_by(x, y) in on:
            draw_tree(canvas, rng, x, y, r, colour)


def draw_car(canvas: Canvas, rng: np.random.Generator, x: float, y: float, angle: float) -> None:
    """A car, van or truck with its long side along `angle`; only on roads and paving."""
    size = rng.random()
    half_u, half_v, rise = (
        (2.2, 0.95, 1.3) if size < 0.85 else (2.7, 1.05, 2.0) if size < 0.97 else (4.6, 1.25, 3.0)
    )
    colour = pick_colour(rng, CARS, spread=5)
    if canvas.covered_by(x, y) not in (ROAD, PAVED):
        return
    stamp = canvas.stamp(x, y, angle, half_u, half_v)
    if stamp is None:
        return
    at = (stamp.rows, stamp.cols)
    u, v = stamp.u_hw, np.abs(stamp.v_hw)
    body = (np.abs(u) < half_u) & (v < half_v) & (canvas.height_HW[at] < rise)
    cabin = (u > -0.75 * half_u) & (u < 0.45 * half_u)
    glass = cabin & ((u < -0.5 * half_u) | (u > 0.15 * half_u)) & (half_u < 4)
    canvas.height_HW[at][body] = np.where(cabin, rise, rise * 0.7)[body]
    canvas.colour_HW3[at][body] = np.where(
        glass[..., None], np.float32(46), np.asarray(colour, np.float32)
    )[body]


def draw_car_park(
    canvas: Canvas,
    rng: np.random.Generator,
    x: float,
    y: float,
    angle: float,
    half_u: float,
    half_v: float,
) -> None:
    """Asphalt with rows of bays along u, randomly occupied, perhaps with trees between rows."""
    canvas.box(
        x, y, angle, half_u, half_v, pick_colour(rng, ASPHALT, spread=10), cover=PAVED, corner_m=1.5
    )
    fullness, bay = float(rng.beta(2, 2)), 2.7
    c, s = cos(angle), sin(angle)
    rows = np.arange(-half_v + 3.2, half_v - 2.6, 8.4)
    green = rng.random() < 0.35
    for row, v in enumerate(rows):
        if green and row % 2 == 1:
            canvas.box(
                x - s * (v + 4.2),
                y + c * (v + 4.2),
                angle,
                half_u - 3,
                0.9,
                (104, 116, 72),
                cover=GROUND,
                grass=0.9,
                corner_m=0.8,
            )
        stamp = canvas.stamp(x - s * v, y + c * v, angle, half_u - 2, 2.5)
        if stamp is not None:
            line = np.abs(np.mod(stamp.u_hw + bay / 2, bay) - bay / 2) < max(
                0.1, 0.28 * canvas.metres_per_pixel
            )
            inside = (np.abs(stamp.u_hw) < half_u - 2) & (np.abs(stamp.v_hw) < 2.5)
            canvas.paint(stamp, (line & inside) * np.float32(0.5), WHITE)
        for u in np.arange(-half_u + 2 + bay / 2, half_u - 2, bay):
            if rng.random() < fullness:
                jitter = rng.normal(0, 0.15, 2)
                at_u, at_v = float(u + jitter[0]), float(v + jitter[1])
                draw_car(
                    canvas,
                    rng,
                    x + c * at_u - s * at_v,
                    y + s * at_u + c * at_v,
                    angle + pi / 2 * float(rng.choice([-1, 1])),
                )


def draw_path(
    canvas: Canvas,
    points: list[tuple[float, float]],
    width: float,
    colour: Colour,
    *,
    cover: int = PAVED,
) -> None:
    """A path through the points (x, y)."""
    for (x0, y0), (x1, y1) in pairwise(points):
        length = hypot(x1 - x0, y1 - y0)
        canvas.box(
            (x0 + x1) / 2,
            (y0 + y1) / 2,
            float(np.arctan2(y1 - y0, x1 - x0)),
            length / 2 + width / 2,
            width / 2,
            colour,
            cover=cover,
            corner_m=width / 2,
        )


def draw_water(
    canvas: Canvas,
    rng: np.random.Generator,
    x: float,
    y: float,
    angle: float,
    half_u: float,
    half_v: float,
    *,
    wobble: float = 0.25,
) -> None:
    """A pond with an irregular shore and a darker middle."""
    stamp = canvas.stamp(x, y, angle, half_u * 1.3, half_v * 1.3)
    if stamp is None:
        return
    at = (stamp.rows, stamp.cols)
    phase = rng.uniform(0, 2 * pi, 3)
    turn = np.arctan2(stamp.v_hw / half_v, stamp.u_hw / half_u)
    shore = 1 + wobble * (0.5 * np.sin(2 * turn + phase[0]) + 0.35 * np.sin(3 * turn + phase[1])
                          + 0.2 * np.sin(5 * turn + phase[2]))  # fmt: skip
    inside = (shore - np.hypot(stamp.u_hw / half_u, stamp.v_hw / half_v)) * np.float32(
        min(half_u, half_v)
    )
    colour = np.asarray(pick_colour(rng, WATERS), np.float32)
    deep = (1.12 - 0.12 * np.clip(inside / 4, 0, 1) + 0.02 * canvas.lumps_HW[at])[..., None]
    canvas.paint(stamp, canvas.coverage(inside + 1.2), (142, 132, 104), grass=0.4)
    canvas.paint(stamp, canvas.coverage(inside), (deep * colour).astype(np.float32), cover=WATER)


def draw_pool(canvas: Canvas, rng: np.random.Generator, x: float, y: float, angle: float) -> None:
    """A swimming pool with its terrace."""
    hu, hv = float(rng.uniform(2.6, 5)), float(rng.uniform(1.6, 2.6))
    canvas.box(x, y, angle, hu + 1.4, hv + 1.4, (190, 182, 166), cover=PAVED, corner_m=0.8)
    canvas.box(
        x,
        y,
        angle,
        hu,
        hv,
        (92, 178, 196),
        cover=WATER,
        corner_m=min(hv * 0.8, float(rng.uniform(0.2, 2))),
    )
