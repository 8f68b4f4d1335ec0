"""The large central building of a town: a footprint that differs from town to town, built of parts.

Lengths in a footprint are fractions of the target radius, so that every family of footprints fills
the last frame of the flight.
"""

from dataclasses import dataclass
from math import cos, pi, sin

import numpy as np

from pipeline.simulation.canvas import Canvas, Colour
from pipeline.simulation.palette import (
    FLAT_ROOFS,
    METAL_ROOFS,
    PITCHED_ROOFS,
    pick_colour,
    random_facade,
    scale_brightness,
)
from pipeline.simulation.town.buildings import (
    BuildingPart,
    Roof,
    add_facade,
    furnish_flat_roof,
    raise_part,
)


@dataclass(frozen=True, kw_only=True)
class Wing:
    """A box or ellipse of a footprint: centre, half sizes, height relative to the building's."""

    u: float
    v: float
    hu: float
    hv: float
    high: float = 1.0
    turn: float = 0.0
    round: bool = False


def random_footprint(rng: np.random.Generator) -> list[Wing]:
    """Wings of one of a dozen families, in random proportions, perhaps mirrored."""
    t, s = float(rng.uniform(0.16, 0.30)), float(rng.uniform(0.6, 1.0))
    high = rng.uniform(0.55, 1.15, 8)
    family = int(rng.integers(14))
    a, b = float(rng.uniform(0.55, 0.95)), float(rng.uniform(0.45, 0.9))
    wings: list[Wing]
    if family == 0:  # L
        wings = [Wing(u=0, v=-b + t, hu=a, hv=t), Wing(u=-a + t, v=0, hu=t, hv=b, high=high[0])]
    elif family == 1:  # U
        wings = [Wing(u=0, v=-b + t, hu=a, hv=t), Wing(u=-a + t, v=0, hu=t, hv=b, high=high[0]),
                 Wing(u=a - t, v=-b * (1 - s), hu=t, hv=b * s, high=high[1])]  # fmt: skip
    elif family == 2:  # H
        wings = [
            Wing(u=-a + t, v=0, hu=t, hv=b),
            Wing(u=a - t, v=0, hu=t, hv=b * s, high=high[0]),
            Wing(u=0, v=float(rng.uniform(-0.3, 0.3)), hu=a, hv=t * 0.8, high=high[1]),
        ]
    elif family == 3:  # T
        wings = [
            Wing(u=0, v=b - t, hu=a, hv=t),
            Wing(u=float(rng.uniform(-0.3, 0.3)), v=0, hu=t, hv=b, high=high[0]),
        ]
    elif family == 4:  # around a court
        wings = [
            Wing(u=0, v=-b + t, hu=a, hv=t),
            Wing(u=0, v=b - t, hu=a, hv=t, high=high[0]),
            Wing(u=-a + t, v=0, hu=t, hv=b, high=high[1]),
            Wing(u=a - t, v=0, hu=t, hv=b, high=high[2]),
        ]
        if rng.random() < 0.4:
            wings.append(Wing(u=0, v=0, hu=a, hv=t * 0.7, high=high[3]))
    elif family == 5:  # a round hall with wings
        wings = [
            Wing(u=0, v=0, hu=0.5, hv=0.5, high=1.2, round=True),
            *(
                Wing(
                    u=0.62 * cos(k * 2 * pi / 3),
                    v=0.62 * sin(k * 2 * pi / 3),
                    hu=0.36,
                    hv=t,
                    high=high[k],
                    turn=k * 2 * pi / 3,
                )
                for k in range(int(rng.integers(0, 4)))
            ),
        ]
    elif family == 6:  # an ellipse, an arena
        wings = [
            Wing(u=0, v=0, hu=a, hv=max(0.45, a * s), round=True),
            Wing(u=0, v=0, hu=a * 0.5, hv=0.25, high=0.6),
        ]
    elif family == 7:  # E
        wings = [Wing(u=0, v=-b + t, hu=a, hv=t)]
        wings += [
            Wing(u=k * (a - t * 0.7), v=0, hu=t * 0.7, hv=b, high=high[k + 1]) for k in (-1, 0, 1)
        ]
    elif family == 8:  # a podium with towers
        wings = [Wing(u=0, v=0, hu=a, hv=b, high=0.45)]
        wings += [
            Wing(
                u=float(rng.uniform(-0.5, 0.5)) * a,
                v=float(rng.uniform(-0.5, 0.5)) * b,
                hu=float(rng.uniform(0.18, 0.34)),
                hv=float(rng.uniform(0.14, 0.3)),
                high=float(rng.uniform(1.1, 2.1)),
            )
            for _ in range(int(rng.integers(1, 4)))
        ]
    elif family == 9:  # a bent slab
        bend = float(rng.uniform(0.3, 0.9))
        wings = [
            Wing(u=-0.42, v=0.1, hu=0.5, hv=t, turn=bend / 2),
            Wing(u=0.42, v=0.1, hu=0.5, hv=t, turn=-bend / 2, high=high[0]),
        ]
        wings.append(Wing(u=0, v=0.1, hu=t * 1.2, hv=t * 1.2, high=1.15))
    elif family == 10:  # steps
        wings = [
            Wing(u=(k - 1) * 0.5, v=(k - 1) * 0.32, hu=0.4, hv=0.34, high=0.6 + 0.3 * k)
            for k in range(3)
        ]
    elif family == 11:  # a cross
        wings = [Wing(u=0, v=0, hu=a, hv=t), Wing(u=0, v=0.1, hu=t, hv=b, high=high[0]),
                 Wing(u=0, v=0, hu=t * 1.3, hv=t * 1.3, high=1.3)]  # fmt: skip
    elif family == 12:  # a cluster of halls
        cells = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        chosen = rng.permutation(9)[: int(rng.integers(4, 8))]
        wings = [
            Wing(
                u=cells[k][0] * 0.52,
                v=cells[k][1] * 0.46,
                hu=float(rng.uniform(0.2, 0.29)),
                hv=float(rng.uniform(0.16, 0.25)),
                high=float(rng.uniform(0.5, 1.1)),
            )
            for k in chosen
        ]
        wings.append(Wing(u=0, v=0, hu=0.75, hv=0.06, high=0.4))
    else:  # one big hall, with annexes
        wings = [Wing(u=0, v=0, hu=a, hv=min(0.55, b))]
        wings += [
            Wing(
                u=float(rng.uniform(-0.6, 0.6)),
                v=float(rng.choice([-1, 1])) * min(0.55, b),
                hu=float(rng.uniform(0.1, 0.3)),
                hv=float(rng.uniform(0.1, 0.25)),
                high=float(rng.uniform(0.4, 0.9)),
            )
            for _ in range(int(rng.integers(1, 4)))
        ]
    return wings


def build_landmark(
    canvas: Canvas, rng: np.random.Generator, *, angle: float, radius_m: float
) -> None:
    """Build it around (0, 0), with its longer axis at `angle`."""
    storeys = float(rng.uniform(8.0, 22.0))
    walls = add_facade(canvas, random_facade(rng, kind="block"))
    second = add_facade(canvas, random_facade(rng, kind="block"))
    main, other = _random_roof_material(rng), _random_roof_material(rng)
    mixed = rng.random() < 0.45
    flip = -1.0 if rng.random() < 0.5 else 1.0
    scale = radius_m * 0.94
    for index, wing in enumerate(sorted(random_footprint(rng), key=lambda w: -w.hu * w.hv)):
        skin = other if mixed and index % 2 else main
        c, s = cos(angle), sin(angle)
        u, v = wing.u * scale, wing.v * scale * flip
        hu, hv = wing.hu * scale, wing.hv * scale
        short = min(hu, hv)
        roof = _random_roof(rng, skin, short=short, round_=wing.round)
        eave = max(4.0, storeys * wing.high) * (
            0.75 if roof.kind in ("barrel", "dome", "sawtooth") else 1.0
        )
        part = BuildingPart(
            x=c * u - s * v,
            y=s * u + c * v,
            angle=angle + wing.turn * flip,
            half_u=hu,
            half_v=hv,
            eave_m=eave,
            roof=roof,
            facade=second if mixed and index % 2 else walls,
            round=wing.round,
        )
        raise_part(canvas, part)
        if roof.kind == "flat":
            furnish_flat_roof(canvas, part, rng)
        if wing.round and roof.kind == "flat":
            lantern = BuildingPart(
                x=part.x,
                y=part.y,
                angle=part.angle,
                half_u=hu * 0.45,
                half_v=hv * 0.45,
                eave_m=eave + 2.5,
                roof=Roof(kind="dome", colour=pick_colour(rng, METAL_ROOFS), rise_m=hv * 0.3),
                facade=second,
                round=True,
            )
            raise_part(canvas, lantern)


RoofMaterial = tuple[str, Colour]


def _random_roof_material(rng: np.random.Generator) -> RoofMaterial:
    """A roof's material: ("flat" | "pitched" | "metal", colour)."""
    cut = rng.random()
    if cut < 0.62:
        return "flat", pick_colour(rng, FLAT_ROOFS)
    if cut < 0.87:
        return "pitched", pick_colour(rng, PITCHED_ROOFS)
    return "metal", pick_colour(rng, METAL_ROOFS)


def _random_roof(
    rng: np.random.Generator, skin: RoofMaterial, *, short: float, round_: bool
) -> Roof:
    kind, colour = skin
    cut = rng.random()
    if round_:
        if kind == "flat" and cut < 0.6:
            return Roof(
                kind="flat", colour=colour, seam_m=5.0, parapet=scale_brightness(colour, 1.12)
            )
        return Roof(
            kind="dome", colour=colour, rise_m=short * float(rng.uniform(0.25, 0.5)), seam_m=1.6
        )
    if kind == "pitched":
        return Roof(
            kind="hip" if cut < 0.5 else "gable",
            colour=colour,
            rise_m=min(7.0, short * float(rng.uniform(0.4, 0.6))),
            seam_m=1.1,
        )
    if kind == "metal":
        shape = "barrel" if cut < 0.45 else "sawtooth" if cut < 0.7 else "gable"
        rise = {"barrel": 0.4, "sawtooth": 0.18, "gable": 0.25}[shape]
        if shape == "barrel":
            return Roof(kind="barrel", colour=colour, rise_m=short * rise, seam_m=1.8)
        if shape == "sawtooth":
            return Roof(kind="sawtooth", colour=colour, rise_m=min(3.5, short * rise), seam_m=1.8)
        return Roof(kind="gable", colour=colour, rise_m=min(4.0, short * rise), seam_m=1.8)
    return Roof(
        kind="flat",
        colour=colour,
        seam_m=float(rng.choice([0.0, 4.0, 7.0])),
        parapet=scale_brightness(colour, float(rng.uniform(0.8, 1.25))),
    )
