"""Which place candidates agree on, and where it lies: cases worked by hand."""

import numpy as np
import pytest

from pipeline.core.arrays import Doubles
from pipeline.core.geo import EARTH_RADIUS_M, haversine_m
from pipeline.locate.consensus import find_consensus, geometric_median, support_weights

DEGREE_M = EARTH_RADIUS_M * np.pi / 180  # of latitude: 111.2 km


def at(*places: tuple[float | None, float | None]) -> Doubles:
    return np.array(places, np.float64)


def test_a_candidate_weighs_its_score_above_the_last_one_s() -> None:
    assert support_weights(np.array([0.9, 0.7, 0.5])) == pytest.approx([1, 0.25, 0])
    assert support_weights(np.array([0.4, 0.4])).tolist() == [1, 1]


def test_three_that_stand_together_outweigh_a_better_one_alone() -> None:
    """Weights 1, 0.64, 0.64, 0.36, 0: the three have 1.64 within 100 m of the middle one, the best
    has 1.
    """
    places = at((10, 20), (50, 60), (50.0005, 60), (49.9995, 60), (-30, 0))
    found = find_consensus(np.array([0.9, 0.8, 0.8, 0.7, 0.4]), list("abcde"), places, 100)
    assert found.members_K.tolist() == [False, True, True, True, False]
    assert (found.leader, found.best_other_score) == (1, 0.9)
    assert haversine_m(at((found.lat, found.lon)), at((50, 60)))[0] < 60


def test_many_that_stand_together_by_chance_do_not_outweigh_one_that_stands_out() -> None:
    """Weights 1 and four times 0.04: by their share unsquared the four would have 0.8."""
    places = at((10, 20), *[(50, 60)] * 4, (-30, 0))
    found = find_consensus(np.array([0.9, 0.5, 0.5, 0.5, 0.5, 0.4]), list("abcdef"), places, 100)
    assert (found.leader, found.lat, found.best_other_score) == (0, 10, 0.5)


def test_images_of_one_location_agree_wherever_they_are() -> None:
    """Without positions names decide: weights 1, 0.77, 0.56, 0, and b has 1.33."""
    nowhere = at(*[(None, None)] * 4)
    found = find_consensus(np.array([0.9, 0.85, 0.8, 0.5]), list("abbc"), nowhere, 100)
    assert (found.leader, found.lat, found.lon, found.spread_m) == (1, None, None, 0)
    assert found.best_other_score == 0.9


def test_members_without_a_position_support_a_place_but_do_not_move_it() -> None:
    found = find_consensus(
        np.array([0.9, 0.8, 0.2]), list("aab"), at((None, None), (5, 6), (7, 8)), 10
    )
    assert (found.lat, found.lon) == (5, 6)


def test_one_candidate_is_its_own_place_and_nothing_is_elsewhere() -> None:
    found = find_consensus(np.array([0.3]), ["a"], at((1, 2)), 10)
    assert (found.leader, found.lat, found.lon, found.best_other_score) == (0, 1, 2, 0.3)


def test_an_unlike_neighbour_does_not_pull_the_place_away() -> None:
    """Weight 1 against 0.9 and 0 at 300 m: the median stays where the best is."""
    places = at((46, 8), (46 + 300 / DEGREE_M, 8), (0, 0))
    found = find_consensus(np.array([0.9, 0.85, 0.4]), list("abc"), places, 400)
    assert found.members_K.tolist() == [True, True, False]
    assert (found.lat, found.lon) == (46, 8)


def test_equal_neighbours_all_round_draw_the_place_to_their_middle() -> None:
    d = 1e-4
    lat, lon = geometric_median(at((d, 0), (-d, 0), (0, d), (0, -d)), np.ones(4))
    assert haversine_m(at((lat, lon)), at((0, 0)))[0] < 1e-3


def test_the_median_lies_where_no_step_lessens_the_sum_of_distances() -> None:
    rng = np.random.default_rng(0)
    places, weight = np.array([46, 8]) + rng.normal(size=(6, 2)) * 1e-3, rng.uniform(0.5, 1, 6)
    found = np.array(geometric_median(places, weight))

    def cost(place: Doubles) -> float:
        return float((weight * haversine_m(places, place)).sum())

    steps = 1e-6 * np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
    assert all(cost(found) <= cost(found + step) + 1e-6 for step in steps)


def test_a_place_on_the_meridian_of_180_degrees_stays_there() -> None:
    places = at((0, 179.9999), (0, -179.9999), (0.0001, 180), (-0.0001, 180))
    found = find_consensus(np.array([0.9, 0.9, 0.9, 0.9]), list("abcd"), places, 50)
    assert found.members_K.all()
    assert haversine_m(at((found.lat, found.lon)), at((0, 180)))[0] < 1
    assert found.spread_m == pytest.approx(11.12, abs=0.05)
