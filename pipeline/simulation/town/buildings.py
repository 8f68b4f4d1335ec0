"""Buildings: parts with a footprint, walls and a roof, added to a canvas; furniture of flat roofs.

Letters: h, w pixels of a stamp's window; 3 red, green, blue.
"""

from dataclasses import dataclass
from math import cos, pi, sin
from typing import Literal

import numpy as np

from pipeline.simulation.canvas import BUILDING, Canvas, Colour, Stamp
from pipeline.simulation.palette import pick_colour, scale_brightness
from pipeline.simulation.world import Facade, FloatMap

RoofKind = Literal["flat", "gable", "hip", "barrel", "sawtooth", "dome"]


@dataclass(frozen=True, kw_only=True)
class Roof:
    """Shape and material of a roof. Metres."""

    kind: RoofKind
    colour: Colour
    rise_m: float = 0.0
    """Height of the ridge above the eaves."""
    seam_m: float = 0.0
    """Period of the seams, ribs or courses; 0: none."""
    parapet: Colour | None = None
    """Colour of the rim of a flat roof; None: no rim."""


@dataclass(frozen=True, kw_only=True)
class BuildingPart:
    """A box, or an ellipse, of a building: centre (x, y), u axis at `angle`, half sizes, height of
    the eaves.
    """

    x: float
    y: float
    angle: float
    half_u: float
    half_v: float
    eave_m: float
    roof: Roof
    facade: int
    """Number of the facade, from `add_facade`."""
    round: bool = False


def add_facade(canvas: Canvas, facade: Facade) -> int:
    """Add a facade to the canvas; its number. A byte map holds 255; later ones share a number."""
    if len(canvas.facades) < 255:
        canvas.facades.append(facade)
        return len(canvas.facades)
    return 1 + len(canvas.facades) // 2


def to_map(part: BuildingPart, u: float, v: float) -> tuple[float, float]:
    """Map coordinates of a point in the part's own frame."""
    c, s = cos(part.angle), sin(part.angle)
    return part.x + c * u - s * v, part.y + s * u + c * v


def raise_part(canvas: Canvas, part: BuildingPart) -> None:
    """Draw the part on all pixels where it is higher than the surface so far."""
    stamp = canvas.stamp(part.x, part.y, part.angle, part.half_u, part.half_v)
    if stamp is None:
        return
    to_u, to_v = part.half_u - np.abs(stamp.u_hw), part.half_v - np.abs(stamp.v_hw)
    if part.round:
        radius = np.hypot(stamp.u_hw / part.half_u, stamp.v_hw / part.half_v)
        inside = (1 - radius) * np.float32(min(part.half_u, part.half_v))
    else:
        inside = np.minimum(to_u, to_v)
    top = _roof_heights(part, stamp, inside)
    at = (stamp.rows, stamp.cols)
    built = (inside > 0) & (top > canvas.height_HW[at])
    if not built.any():
        return
    canvas.height_HW[at][built] = top[built]
    canvas.colour_HW3[at][built] = _roof_colours(canvas, part, stamp, inside)[built]
    for cleared in (canvas.grass_HW, canvas.trees_HW):
        cleared[at][built] = 0
    canvas.cover_HW[at][built] = BUILDING
    canvas.facade_HW[at][built] = part.facade
    along, facing = _walls(part, stamp, to_u < to_v)
    canvas.along_HW[at][built] = along[built]
    canvas.facing_HW[at][built] = facing[built]


def _roof_heights(part: BuildingPart, stamp: Stamp, inside: FloatMap) -> FloatMap:
    """Height of the roof over the window, metres; ridges run along the longer side."""
    roof, eave = part.roof, np.float32(part.eave_m)
    long, short = (
        (stamp.u_hw, stamp.v_hw) if part.half_u >= part.half_v else (stamp.v_hw, stamp.u_hw)
    )
    half_long, half_short = max(part.half_u, part.half_v), min(part.half_u, part.half_v)
    rise = np.float32(roof.rise_m)
    if roof.kind == "gable":
        shape = 1 - np.abs(short) / half_short
    elif roof.kind == "hip":
        shape = np.minimum(1 - np.abs(short) / half_short, (half_long - np.abs(long)) / half_short)
    elif roof.kind == "barrel":
        shape = np.sqrt(np.maximum(0, 1 - (short / half_short) ** 2))
    elif roof.kind == "sawtooth":
        period = max(5.0, half_long / 3)
        shape = np.mod(long + half_long, period) / period
    elif roof.kind == "dome":
        shape = np.sqrt(np.maximum(0, 1 - (long / half_long) ** 2 - (short / half_short) ** 2))
    else:
        rim = 0.7 if roof.parapet is not None else 0.0
        shape = (inside < 0.55).astype(np.float32)
        rise = np.float32(rim)
    heights: FloatMap = (eave + rise * np.clip(shape, 0, 1)).astype(np.float32)
    return heights


def _roof_colours(canvas: Canvas, part: BuildingPart, stamp: Stamp, inside: FloatMap) -> FloatMap:
    """Colours of the roof over the window (h, w, 3): seams, stains, ridges and rims."""
    roof = part.roof
    at = (stamp.rows, stamp.cols)
    long, short = (
        (stamp.u_hw, stamp.v_hw) if part.half_u >= part.half_v else (stamp.v_hw, stamp.u_hw)
    )
    half_short = min(part.half_u, part.half_v)
    tone = 1 + 0.05 * canvas.patches_HW[at] + 0.04 * canvas.lumps_HW[at]
    if roof.seam_m > 0:
        # Seams of a membrane run across the roof, ribs of metal and courses of tiles down its
        # slope.
        run = short if roof.kind == "flat" and roof.seam_m > 2 else long
        width = max(0.22, 0.8 * canvas.metres_per_pixel)
        near_seam = np.mod(run + np.float32(roof.seam_m / 2), np.float32(roof.seam_m)) < width
        tone = tone - (0.10 if roof.seam_m > 2 else 0.06) * near_seam
    if roof.kind in ("gable", "hip", "barrel"):
        tone = tone + 0.10 * (np.abs(short) < 0.35)
        tone = tone - 0.08 * (np.abs(short) > half_short - 0.4)
    if roof.kind == "sawtooth":
        # The vertical side of a tooth is glass.
        period = max(5.0, max(part.half_u, part.half_v) / 3)
        tone = tone - 0.35 * (np.mod(long + max(part.half_u, part.half_v), period) > period - 1.0)
    colours: FloatMap = tone[..., None].astype(np.float32) * np.asarray(roof.colour, np.float32)
    if roof.kind == "flat" and roof.parapet is not None:
        colours[inside < 0.55] = roof.parapet
        # Dirt gathers along the rim, which keeps the rain.
        colours *= (1 - 0.10 * np.exp(-np.maximum(inside - 0.55, 0) / 1.2) * (inside >= 0.55))[
            ..., None
        ]
    return colours


def _walls(part: BuildingPart, stamp: Stamp, nearest_is_u: np.ndarray) -> tuple[FloatMap, FloatMap]:
    """Metres along the nearest wall, and the compass direction in radians that it faces."""
    if part.round:
        turn = np.arctan2(stamp.v_hw, stamp.u_hw)
        return (turn * np.float32((part.half_u + part.half_v) / 2)).astype(np.float32), _compass(
            turn + part.angle
        )
    along = np.where(nearest_is_u, stamp.v_hw, stamp.u_hw)
    outward_u = np.where(stamp.u_hw > 0, np.float32(0), np.float32(pi))
    outward_v = np.where(stamp.v_hw > 0, np.float32(pi / 2), np.float32(-pi / 2))
    return along.astype(np.float32), _compass(
        np.where(nearest_is_u, outward_u, outward_v) + part.angle
    )


def _compass(turn: np.ndarray) -> FloatMap:
    """Radians counter-clockwise from east -> clockwise from north."""
    compass: FloatMap = np.mod(np.float32(pi / 2) - turn, np.float32(2 * pi)).astype(np.float32)
    return compass


def furnish_flat_roof(
    canvas: Canvas, part: BuildingPart, rng: np.random.Generator, *, richness: float = 1.0
) -> None:
    """Place machines, skylights, a stair house, vents, walkways or solar panels on a flat roof."""
    half_u, half_v = part.half_u - 2.0, part.half_v - 2.0
    if half_u < 1.5 or half_v < 1.5 or part.round:
        return
    area = 4 * half_u * half_v
    plain = Facade(wall=(170, 170, 168), glass=(120, 120, 120), window_high=0.0)
    metal = (
        canvas.facades.index(plain) + 1 if plain in canvas.facades else add_facade(canvas, plain)
    )

    def stand(u: float, v: float, hu: float, hv: float, rise: float, colour: Colour) -> None:
        x, y = to_map(part, u, v)
        raise_part(
            canvas,
            BuildingPart(
                x=x,
                y=y,
                angle=part.angle,
                half_u=hu,
                half_v=hv,
                eave_m=part.eave_m + rise,
                roof=Roof(kind="flat", colour=colour),
                facade=metal,
            ),
        )

    look = rng.random()
    if look < 0.22 and area > 150:  # rows of solar panels
        fill_u, fill_v = rng.uniform(0.35, 0.95), rng.uniform(0.4, 0.95)
        shift = rng.uniform(-1, 1) * half_u * (1 - fill_u)
        for v in np.arange(-half_v * fill_v, half_v * fill_v, 2.6):
            stand(shift, float(v), half_u * fill_u, 0.8, 0.4, (44, 52, 78))
    elif look < 0.50 and area > 120:  # rows of skylights
        step = rng.uniform(4, 7)
        rows = 1 if half_v < 5 else int(rng.integers(1, 4))
        for row in range(rows):
            v = 0.0 if rows == 1 else (row / (rows - 1) - 0.5) * half_v * 1.4
            for u in np.arange(-half_u + 1, half_u - 1, step):
                stand(float(u), v, step * 0.28, min(1.1, half_v * 0.5), 0.5, (206, 218, 222))
    elif look < 0.58 and area > 250:  # a roof garden
        x, y = to_map(part, 0, 0)
        canvas.box(
            x, y, part.angle, half_u * 0.85, half_v * 0.8, (104, 118, 74), cover=BUILDING, grass=0.8
        )
    for _ in range(int(rng.poisson(min(14.0, 1.0 + area / 110) * richness))):
        size_u, size_v = rng.uniform(0.6, 2.2), rng.uniform(0.6, 1.6)
        u, v = rng.uniform(-1, 1) * (half_u - size_u), rng.uniform(-1, 1) * (half_v - size_v)
        stand(float(u), float(v), float(size_u), float(size_v), float(rng.uniform(0.8, 2.2)),
              scale_brightness((190, 190, 188), float(rng.uniform(0.6, 1.2))))  # fmt: skip
    if area > 300 and rng.random() < 0.75:  # the stair house, and the lifts
        u, v = rng.uniform(-0.6, 0.6) * half_u, rng.uniform(-0.6, 0.6) * half_v
        stand(
            float(u),
            float(v),
            float(rng.uniform(2.0, 4.5)),
            float(rng.uniform(1.8, 3.2)),
            3.2,
            pick_colour(rng, (part.roof.colour,), spread=16),
        )
