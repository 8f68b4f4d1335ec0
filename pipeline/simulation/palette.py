"""Colours and facades of all towns: shared, so that no colour identifies a location.

sRGB, 0 to 255, in even light.
"""

import numpy as np

from pipeline.simulation.canvas import Colour
from pipeline.simulation.world import Facade

GRASS: tuple[Colour, ...] = (
    (92, 112, 62),
    (104, 118, 70),
    (82, 108, 66),
    (118, 122, 78),
    (132, 124, 88),
)
TREES: tuple[Colour, ...] = ((56, 80, 42), (66, 88, 46), (48, 70, 44), (76, 92, 50), (60, 74, 50))
ASPHALT: tuple[Colour, ...] = (
    (104, 104, 106),
    (88, 88, 92),
    (124, 120, 116),
    (74, 74, 78),
    (138, 134, 128),
)
PAVING: tuple[Colour, ...] = (
    (176, 172, 162),
    (160, 154, 144),
    (188, 180, 164),
    (150, 146, 142),
    (170, 142, 122),
)
EARTH: tuple[Colour, ...] = ((156, 134, 106), (168, 150, 124), (136, 116, 92))
WATER_COLOURS: tuple[Colour, ...] = ((52, 72, 76), (62, 82, 74), (44, 60, 74))
FLAT_ROOFS: tuple[Colour, ...] = (
    (196, 196, 194),
    (226, 226, 222),
    (168, 164, 158),
    (112, 110, 110),
    (84, 84, 88),
    (180, 168, 148),
    (148, 142, 138),
    (204, 192, 172),
    (134, 122, 110),
)
PITCHED_ROOFS: tuple[Colour, ...] = (
    (176, 98, 68),
    (152, 84, 62),
    (112, 92, 80),
    (86, 84, 88),
    (104, 108, 116),
    (132, 122, 112),
    (142, 106, 84),
    (70, 72, 78),
    (160, 150, 138),
)
METAL_ROOFS: tuple[Colour, ...] = (
    (186, 190, 194),
    (150, 160, 166),
    (112, 140, 130),
    (128, 84, 72),
    (206, 206, 200),
)
CARS: tuple[Colour, ...] = (
    (226, 226, 226),
    (236, 236, 232),
    (40, 42, 46),
    (60, 62, 66),
    (122, 124, 128),
    (168, 170, 174),
    (132, 38, 38),
    (44, 62, 110),
    (200, 198, 190),
    (90, 84, 74),
)
COURTS: tuple[tuple[Colour, Colour], ...] = (  # (the court, the ground around it)
    ((70, 104, 92), (126, 72, 62)),
    ((72, 94, 128), (84, 116, 92)),
    ((150, 88, 70), (96, 116, 84)),
    ((104, 92, 104), (112, 100, 108)),
)
WALLS: tuple[Colour, ...] = (
    (166, 110, 86),
    (190, 176, 152),
    (206, 202, 194),
    (148, 140, 132),
    (128, 92, 76),
    (216, 208, 188),
    (172, 160, 148),
    (120, 122, 126),
    (182, 140, 108),
)
WHITE: Colour = (222, 222, 214)
"Colour of painted lines."
GLASS: tuple[Colour, ...] = ((58, 70, 82), (72, 90, 100), (46, 54, 60), (92, 112, 122))


def pick_colour(
    rng: np.random.Generator, colours: tuple[Colour, ...], *, spread: float = 7.0
) -> Colour:
    """One of the colours with slightly varied lightness and hue, as paint and weather vary it."""
    r, g, b = colours[int(rng.integers(len(colours)))]
    light = float(rng.normal(0, spread))
    hue = rng.normal(0, spread * 0.2, 3)
    return (r + light + float(hue[0]), g + light + float(hue[1]), b + light + float(hue[2]))


def scale_brightness(colour: Colour, factor: float) -> Colour:
    """The colour made lighter (factor above 1) or darker."""
    return (
        min(250.0, colour[0] * factor),
        min(250.0, colour[1] * factor),
        min(250.0, colour[2] * factor),
    )


def random_facade(rng: np.random.Generator, *, kind: str) -> Facade:
    """A facade of a kind: "house", "hall" (few windows) or "block" (punched, ribbon or curtain)."""
    wall, glass = pick_colour(rng, WALLS), pick_colour(rng, GLASS)
    if kind == "house":
        return Facade(wall=wall, glass=glass, storey_m=2.9, bay_m=float(rng.uniform(2.6, 4.2)),
                      window_wide=0.38, window_high=0.42)  # fmt: skip
    if kind == "hall":
        return Facade(
            wall=wall,
            glass=glass,
            storey_m=float(rng.uniform(4.5, 6.5)),
            bay_m=float(rng.uniform(5, 9)),
            window_wide=float(rng.choice([0.0, 0.5, 1.0])),
            window_high=0.28,
        )
    storey = float(rng.uniform(3.2, 4.2))
    look = int(rng.integers(3))
    if look == 0:
        return Facade(wall=wall, glass=glass, storey_m=storey, bay_m=float(rng.uniform(2.4, 4.5)),
                      window_wide=float(rng.uniform(0.4, 0.6)), window_high=0.52)  # fmt: skip
    if look == 1:
        return Facade(wall=wall, glass=glass, storey_m=storey, window_wide=1.0,
                      window_high=float(rng.uniform(0.35, 0.55)))  # fmt: skip
    return Facade(
        wall=scale_brightness(wall, 0.8),
        glass=glass,
        storey_m=storey,
        bay_m=float(rng.uniform(1.6, 3.0)),
        window_wide=0.84,
        window_high=0.82,
    )
