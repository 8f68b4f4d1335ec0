"""Season, sun, shadows, sensor and haze: a World and a Day come in, a lit map goes out.

The satellite passes on one day and the UAV flies on another, so that the two views of a place never
look the same.

Letters: H, W pixels of the map; 3 red, green, blue; V 256 values of a byte.
"""

from dataclasses import dataclass
from math import cos, radians, sin
from typing import Literal

import numpy as np

from pipeline.simulation.shadows import cast_shadows
from pipeline.simulation.world import ByteMap, FloatMap, World

Season = Literal["spring", "summer", "autumn", "winter"]
SEASONS: tuple[Season, ...] = ("spring", "summer", "autumn", "winter")
Rgb = tuple[float, float, float]
SHADOW_EDGE_M = 0.5
"Depth below a shadow's top in which the sunlight ends."

# Gains on the summer colours of grass and leaves; each tree's leaves have a gain between the first
# and the second.
GRASS_GAIN: dict[Season, Rgb] = {
    "spring": (0.95, 1.06, 0.90),
    "summer": (1.0, 1.0, 1.0),
    "autumn": (1.06, 0.98, 0.90),
    "winter": (1.06, 0.94, 1.02),
}
LEAF_GAIN: dict[Season, tuple[Rgb, Rgb]] = {
    "spring": ((1.05, 1.08, 0.95), (1.22, 1.20, 0.98)),
    "summer": ((1.0, 1.0, 1.0), (1.0, 1.0, 1.0)),
    "autumn": ((1.15, 1.02, 0.88), (2.00, 1.18, 0.80)),
    "winter": ((1.22, 0.92, 1.28), (1.45, 1.04, 1.45)),
}


@dataclass(frozen=True, kw_only=True)
class Day:
    """Light, air and sensor of one day."""

    season: Season = "summer"
    sun_azimuth_deg: float = 150.0
    """Azimuth of the sun, clockwise from north."""
    sun_elevation_deg: float = 50.0
    shade: float = 0.42
    """Light in a shadow as a fraction of open sun: the light of the sky."""
    haze: float = 0.0
    """Fraction of every pixel's colour that is haze."""
    haze_colour: Rgb = (196, 206, 218)
    gain: Rgb = (1.0, 1.0, 1.0)
    """The sensor's gain per colour."""
    gamma: float = 1.0
    saturation: float = 1.0
    noise: float = 2.0
    """Standard deviation of the sensor's noise, in byte values."""

    def __post_init__(self) -> None:
        if not 0 < self.sun_elevation_deg <= 90:
            raise ValueError(
                f"sun at {self.sun_elevation_deg} degrees: expected above 0 and up to 90, a day"
            )

    def toward_sun(self) -> Rgb:
        """Unit vector (east, north, up) to the sun."""
        flat = cos(radians(self.sun_elevation_deg))
        azimuth = radians(self.sun_azimuth_deg)
        return flat * sin(azimuth), flat * cos(azimuth), sin(radians(self.sun_elevation_deg))

    def sky_light(self) -> FloatMap:
        """Light of the sky alone, per colour: bluish. Its sum with `sun_light` is about 1."""
        return np.asarray([self.shade * 0.92, self.shade * 1.0, self.shade * 1.14], np.float32)

    def sun_light(self) -> FloatMap:
        """Light of the sun alone on flat ground, per colour: warmer when it is low."""
        warm = max(0.0, 0.10 - self.sun_elevation_deg / 600)
        return np.asarray(
            [1 - self.shade + warm, 1 - self.shade, 1 - self.shade - warm], np.float32
        )

    def curve_3V(self) -> ByteMap:
        """Sensor and haze as a lookup table per colour, from byte to byte."""
        value = np.arange(256, dtype=np.float32) / 255
        rows = []
        for gain, air in zip(self.gain, self.haze_colour, strict=True):
            seen = np.clip(value * gain, 0, 1) ** self.gamma
            rows.append((1 - self.haze) * seen * 255 + self.haze * air)
        return np.clip(np.stack(rows) + 0.5, 0, 255).astype(np.uint8)


def sample_day(rng: np.random.Generator) -> Day:
    """A random day in the temperate north: the sun is in the southern half of the sky."""
    season = SEASONS[int(rng.choice(4, p=[0.25, 0.40, 0.22, 0.13]))]
    low, high = {"spring": (34, 56), "summer": (40, 64), "autumn": (28, 46), "winter": (23, 34)}[
        season
    ]
    warmth = float(rng.normal(0, 0.035))
    bright = float(rng.normal(1.0, 0.07))
    return Day(
        season=season,
        sun_azimuth_deg=float(rng.uniform(100, 260)),
        sun_elevation_deg=float(rng.uniform(low, high)),
        shade=float(rng.uniform(0.34, 0.55)),
        haze=min(0.24, float(rng.beta(1.5, 15.0))),
        gain=(
            bright * (1 + warmth),
            bright * (1 + float(rng.normal(0, 0.015))),
            bright * (1 - warmth),
        ),
        gamma=float(rng.uniform(0.82, 1.12)),
        saturation=float(rng.uniform(0.7, 1.08)),
        noise=float(rng.uniform(1.0, 4.0)),
    )


@dataclass(frozen=True, kw_only=True)
class LitMap:
    """A world's colours on one day, before the sensor, and the height of its shadows."""

    colour_HW3: ByteMap
    shadow_top_HW: FloatMap
    """Metres: surfaces below this height are in shadow at this pixel."""


def light_world(world: World, day: Day) -> LitMap:
    """Apply the season, light the world and cast its shadows."""
    colour_HW3 = _apply_season(world, day.season)
    if world.light_is_baked and not world.height_HW.any():
        shadow_top_HW = np.zeros_like(world.height_HW)
    else:
        shadow_top_HW = cast_shadows(
            world.height_HW, world.metres_per_pixel, toward_sun=day.toward_sun()
        )
    if not world.light_is_baked:
        colour_HW3 *= daylight(world.height_HW, shadow_top_HW, world.metres_per_pixel, day)
    if day.saturation != 1.0:
        grey_HW1 = colour_HW3.mean(axis=2, keepdims=True)
        colour_HW3 = grey_HW1 + np.float32(day.saturation) * (colour_HW3 - grey_HW1)
    return LitMap(
        colour_HW3=np.clip(colour_HW3, 0, 255).astype(np.uint8), shadow_top_HW=shadow_top_HW
    )


def daylight(
    height_HW: FloatMap, shadow_top_HW: FloatMap, metres_per_pixel: float, day: Day
) -> FloatMap:
    """Light (H, W, 3) on ground, roofs and crowns: about 1 on flat ground in the sun."""
    open_HW = 1 - np.clip((shadow_top_HW - height_HW) / np.float32(SHADOW_EDGE_M), 0, 1)
    direct_HW = open_HW * _slope_shading(height_HW, metres_per_pixel, day)
    sky_HW = 1 - np.float32(0.45) * _sky_occlusion(height_HW, metres_per_pixel)
    return np.asarray(
        sky_HW[..., None] * day.sky_light() + direct_HW[..., None] * day.sun_light(), np.float32
    )


def _apply_season(world: World, season: Season) -> FloatMap:
    """Colours with the season's grass and leaves."""
    colour_HW3 = world.texture_HW3.astype(np.float32)
    if season == "summer":
        return colour_HW3
    grass_HW = world.grass_HW.astype(np.float32) / 255
    trees_HW = world.trees_HW.astype(np.float32) / 255
    # Trees have 0.75 to 1: the part above 0.75 is how far a tree's leaves have turned.
    turned_HW = np.clip((trees_HW - 0.75) * 4, 0, 1)
    early, late = LEAF_GAIN[season]
    for c in range(3):
        leaf_HW = early[c] + np.float32(late[c] - early[c]) * turned_HW - 1
        colour_HW3[..., c] *= (
            1 + grass_HW * np.float32(GRASS_GAIN[season][c] - 1) + trees_HW * leaf_HW
        )
    return colour_HW3


def _slope_shading(height_HW: FloatMap, metres_per_pixel: float, day: Day) -> FloatMap:
    """Sunlight on roofs and crowns by their slope, 1 on flat ground; walls count as flat."""
    span = np.float32(2 * metres_per_pixel)
    east_HW, south_HW = np.zeros_like(height_HW), np.zeros_like(height_HW)
    east_HW[:, 1:-1] = (height_HW[:, 2:] - height_HW[:, :-2]) / span
    south_HW[1:-1] = (height_HW[2:] - height_HW[:-2]) / span
    wall_HW = np.maximum(np.abs(east_HW), np.abs(south_HW)) > 2.0
    east_HW[wall_HW] = 0
    south_HW[wall_HW] = 0
    e, n, u = day.toward_sun()
    facing_HW = (u - e * east_HW + n * south_HW) / np.sqrt(1 + east_HW**2 + south_HW**2)
    lit_HW: FloatMap = np.clip(facing_HW / np.float32(u), 0, 1.45).astype(np.float32)
    return lit_HW


def _sky_occlusion(height_HW: FloatMap, metres_per_pixel: float) -> FloatMap:
    """Fraction of the sky that the surroundings hide, estimated from the mean height around."""
    radius = max(1, round(3.5 / metres_per_pixel))
    around_HW = _box_mean(_box_mean(height_HW, radius).T, radius).T
    hidden: FloatMap = np.clip((around_HW - height_HW) / np.float32(6), 0, 1)
    return hidden


def _box_mean(map_HW: FloatMap, radius: int) -> FloatMap:
    """Running mean down the columns, over 2 * radius + 1 pixels."""
    padded = np.pad(map_HW, ((radius + 1, radius), (0, 0)), mode="edge")
    total = np.cumsum(padded, axis=0, dtype=np.float64)
    mean: FloatMap = (
        (total[2 * radius + 1 :] - total[: -2 * radius - 1]) / (2 * radius + 1)
    ).astype(np.float32)
    return mean
