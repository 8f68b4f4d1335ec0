"""Sports grounds: football pitches, tennis courts and baseball diamonds."""

from math import cos, pi, sin

import numpy as np

from pipeline.simulation.canvas import PAVED, Canvas, Colour
from pipeline.simulation.palette import COURTS, EARTH, WHITE, pick_colour, scale_brightness


def draw_pitch(
    canvas: Canvas,
    rng: np.random.Generator,
    x: float,
    y: float,
    angle: float,
    half_u: float,
    half_v: float,
) -> None:
    """A football pitch mown in stripes, with its lines; perhaps a running track around it."""
    c, s = cos(angle), sin(angle)
    if rng.random() < 0.5 and half_v > 20:
        tartan: Colour = (164, 86, 68) if rng.random() < 0.7 else (88, 112, 140)
        canvas.box(x, y, angle, half_u, half_v, tartan, cover=PAVED, corner_m=half_v - 0.1)
        for lane in range(1, 5):
            inset = lane * 1.25
            _outline(canvas, x, y, angle, half_u - inset, half_v - inset, half_v - inset - 0.1)
        half_u, half_v = half_u - 7, half_v - 7
        canvas.box(
            x,
            y,
            angle,
            half_u,
            half_v,
            (96, 122, 66),
            cover=PAVED,
            grass=0.8,
            corner_m=half_v - 0.1,
        )
        half_u, half_v = half_u - half_v * 0.42, half_v * 0.86
    stamp = canvas.stamp(x, y, angle, half_u, half_v)
    if stamp is not None:
        inside = np.minimum(half_u - np.abs(stamp.u_hw), half_v - np.abs(stamp.v_hw))
        stripes = 1 + 0.045 * np.where(np.mod(stamp.u_hw, 11) < 5.5, 1, -1)[..., None]
        turf = np.asarray(
            pick_colour(rng, ((94, 124, 66), (84, 116, 64), (104, 126, 74))), np.float32
        )
        canvas.paint(stamp, canvas.coverage(inside), stripes * turf, cover=PAVED, grass=0.85)
    _outline(canvas, x, y, angle, half_u - 1.5, half_v - 1.5, 0.0)
    canvas.box(x, y, angle, 0.14, half_v - 1.5, WHITE, opacity=0.8)
    canvas.disc(x, y, min(9.1, half_v * 0.4), WHITE, ring_m=0.3)
    for side in (-1, 1):
        u = side * (half_u - 1.5 - half_u * 0.15)
        _outline(canvas, x + c * u, y + s * u, angle, half_u * 0.15, half_v * 0.5, 0.0)


def draw_courts(
    canvas: Canvas,
    rng: np.random.Generator,
    x: float,
    y: float,
    angle: float,
    half_u: float,
    half_v: float,
) -> None:
    """Tennis courts side by side, as many as fit."""
    inner, outer = COURTS[int(rng.integers(len(COURTS)))]
    canvas.box(x, y, angle, half_u, half_v, outer, cover=PAVED)
    c, s = cos(angle), sin(angle)
    across, deep = max(1, int(2 * half_u // 17)), max(1, int(2 * half_v // 35))
    for i in range(across):
        for j in range(deep):
            u = (i + 0.5) * 2 * half_u / across - half_u
            v = (j + 0.5) * 2 * half_v / deep - half_v
            cx, cy = x + c * u - s * v, y + s * u + c * v
            hu, hv = min(5.5, half_u / across - 1), min(11.9, half_v / deep - 1)
            canvas.box(cx, cy, angle, hu + 0.6, hv + 0.6, inner)
            _outline(canvas, cx, cy, angle, hu, hv, 0.0)
            _outline(canvas, cx, cy, angle, hu * 0.75, hv * 0.54, 0.0)
            canvas.box(cx, cy, angle, hu, 0.2, scale_brightness(outer, 0.6))


def draw_diamond(
    canvas: Canvas, rng: np.random.Generator, x: float, y: float, angle: float, radius: float
) -> None:
    """A baseball diamond: infield, bases, mound, mown outfield."""
    earth = pick_colour(rng, EARTH)
    c, s = cos(angle), sin(angle)
    canvas.disc(x, y, radius, (98, 122, 68), grass=0.9, cover=PAVED)
    home_x, home_y = x - c * radius * 0.55, y - s * radius * 0.55
    canvas.disc(home_x + c * radius * 0.33, home_y + s * radius * 0.33, radius * 0.42, earth)
    canvas.disc(home_x, home_y, radius * 0.13, earth)
    side = radius * 0.21
    canvas.box(
        home_x + c * side * 1.5,
        home_y + s * side * 1.5,
        angle + pi / 4,
        side,
        side,
        (100, 124, 70),
        grass=0.9,
    )
    canvas.disc(home_x + c * side * 1.5, home_y + s * side * 1.5, radius * 0.06, earth)


def _outline(
    canvas: Canvas, x: float, y: float, angle: float, half_u: float, half_v: float, corner_m: float
) -> None:
    stamp = canvas.stamp(x, y, angle, half_u + 0.3, half_v + 0.3)
    if stamp is None or half_v <= 0.5:
        return
    du, dv = np.abs(stamp.u_hw) - (half_u - corner_m), np.abs(stamp.v_hw) - (half_v - corner_m)
    edge = (
        np.hypot(np.maximum(du, 0), np.maximum(dv, 0))
        + np.minimum(np.maximum(du, dv), 0)
        - corner_m
    )
    canvas.paint(stamp, canvas.coverage(np.float32(0.14) - np.abs(edge)) * np.float32(0.85), WHITE)
