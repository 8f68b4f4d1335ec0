"""Procedural towns: a pure function of the generator, one large building in the middle, no two
alike.
"""

import numpy as np
import pytest

from pipeline.simulation.location import geotag
from pipeline.simulation.town.town import EXTENT_IN_RADII, make_town
from pipeline.simulation.world import World


def made(seed: int, frame_pixels: int = 64) -> World:
    return make_town(np.random.default_rng([7, seed]), frame_pixels=frame_pixels)


def test_seed_determines_the_town() -> None:
    one, same, other = made(1), made(1), made(2)
    assert (one.texture_HW3 == same.texture_HW3).all()
    assert (one.height_HW == same.height_HW).all()
    assert one.facades_K == same.facades_K
    assert (one.height_HW > 3).mean() > 0.02
    built_one, built_other = one.height_HW > 3, other.height_HW > 3
    assert (built_one & built_other).sum() / (built_one | built_other).sum() < 0.6


def test_town_has_the_same_plan_at_every_resolution() -> None:
    coarse, fine = made(3, 64), made(3, 128)
    assert fine.extent_m == pytest.approx(coarse.extent_m)
    assert coarse.target_radius_m == fine.target_radius_m
    n = coarse.height_HW.shape[0]
    sampled = fine.height_HW[(np.arange(n) * 2)[:, None], np.arange(n) * 2]
    a, b = coarse.height_HW > 2.5, sampled > 2.5
    assert (a & b).sum() / (a | b).sum() > 0.75


@pytest.mark.parametrize("seed", range(6))
def test_large_building_fills_the_middle_within_its_radius(seed: int) -> None:
    world = made(seed)
    axis = (np.arange(world.height_HW.shape[0]) + 0.5) * world.metres_per_pixel - world.extent_m / 2
    away = np.hypot(*np.meshgrid(axis, axis))
    central = (world.height_HW > 4) & (world.facade_HW > 0) & (away < world.target_radius_m)
    assert central.sum() * world.metres_per_pixel**2 > 0.15 * np.pi * world.target_radius_m**2
    assert world.extent_m == pytest.approx(EXTENT_IN_RADII * world.target_radius_m, rel=0.02)


def test_every_facade_number_on_the_map_has_a_facade() -> None:
    world = made(4)
    assert 1 <= world.facade_HW.max() <= len(world.facades_K)


def test_neighbouring_locations_are_200_to_400_m_apart() -> None:
    places = np.array([geotag(n) for n in range(1, 200)])
    metres = (places - places[0]) * 111_320 * [1, np.cos(np.radians(46.5))]
    gaps = np.hypot(*(metres[:, None] - metres[None]).transpose(2, 0, 1)) + 1e9 * np.eye(
        len(metres)
    )
    assert 200 < gaps.min() < 400
