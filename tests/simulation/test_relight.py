"""The sun of a photograph: found by its shadows, and its light taken away."""

from functools import partial

import numpy as np
import pytest

from pipeline.core.arrays import Floats, Pixels
from pipeline.simulation.appearance import Day, daylight
from pipeline.simulation.relight import find_day, without_light
from pipeline.simulation.shadows import cast_shadows
from pipeline.simulation.texture import photographed_world

SIDE, PIXEL_M = 240, 0.5


@pytest.fixture(scope="module")
def ground() -> tuple[Floats, Floats]:
    """Blocks of 4 to 15 m (H, W) on fields of one colour each (H, W, 3)."""
    rng = np.random.default_rng(3)
    height_HW = np.zeros((SIDE, SIDE), np.float32)
    for x, y in rng.integers(10, SIDE - 40, (14, 2)):
        height_HW[y : y + 24, x : x + 16] = rng.uniform(4, 15)
    fields = rng.uniform(90, 150, (8, 8, 3))
    return height_HW, np.kron(fields, np.ones((30, 30, 1))).astype(np.float32)


def lit(ground: tuple[Floats, Floats], day: Day) -> Pixels:
    height_HW, colour_HW3 = ground
    top_HW = cast_shadows(height_HW, PIXEL_M, toward_sun=day.toward_sun())
    seen_HW3 = colour_HW3 * daylight(height_HW, top_HW, PIXEL_M, day)
    return np.clip(seen_HW3, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("azimuth", "elevation"), [(200.0, 35.0), (95.0, 50.0), (262.0, 27.0)])
def test_find_day_is_that_of_the_shadows(
    ground: tuple[Floats, Floats], azimuth: float, elevation: float
) -> None:
    day = Day(sun_azimuth_deg=azimuth, sun_elevation_deg=elevation, shade=0.45)
    found = find_day(lit(ground, day), ground[0], PIXEL_M)
    assert found is not None
    assert found.sun_azimuth_deg == pytest.approx(azimuth, abs=8)
    assert found.sun_elevation_deg == pytest.approx(elevation, abs=6)
    assert found.shade == pytest.approx(0.45, abs=0.15)


def test_find_day_without_heights_or_shadows_is_none(ground: tuple[Floats, Floats]) -> None:
    height_HW, colour_HW3 = ground
    sunny_HW3 = lit(ground, Day())
    assert find_day(sunny_HW3, np.zeros_like(height_HW), PIXEL_M) is None
    assert find_day(np.full_like(sunny_HW3, 120), height_HW, PIXEL_M) is None
    assert find_day(colour_HW3.astype(np.uint8), height_HW, PIXEL_M) is None


def test_without_light_is_near_the_colours_of_the_ground(ground: tuple[Floats, Floats]) -> None:
    height_HW, colour_HW3 = ground
    day = Day(sun_azimuth_deg=200, sun_elevation_deg=35)
    seen_HW3 = lit(ground, day)
    found = find_day(seen_HW3, height_HW, PIXEL_M)
    assert found is not None
    plain_HW3 = without_light(seen_HW3, height_HW, PIXEL_M, found)
    before, after = (np.abs(one - colour_HW3).mean() for one in (seen_HW3, plain_HW3))
    assert after < 0.4 * before


def test_photographed_world_of_a_known_day_has_no_light(ground: tuple[Floats, Floats]) -> None:
    height_HW, colour_HW3 = ground
    day = Day(sun_azimuth_deg=200, sun_elevation_deg=35)
    seen_HW3 = lit(ground, day)
    make = partial(photographed_world, seen_HW3, height_HW, metres_per_pixel=PIXEL_M)
    kept, taken = (make(target_radius_m=20, day=one) for one in (None, day))
    assert kept.light_is_baked
    assert (kept.texture_HW3 == seen_HW3).all()
    assert not taken.light_is_baked
    inside = np.abs(taken.texture_HW3 - colour_HW3)[10:-10, 10:-10]
    assert np.median(inside) <= 1.5
