"""The consensus of candidates and its position: cases by hand."""

import numpy as np
import pytest

from pipeline.core.arrays import Doubles
from pipeline.core.geo import EARTH_RADIUS_M, haversine_m
from pipeline.locate.consensus import find_consensus, geometric_median, support_weights

DEGREE_M = EARTH_RADIUS_M * np.pi / 180  # of latitude: 111.2 km


def at(*positions: tuple[float | None, float | None]) -> Doubles:
    return np.array(positions, np.float64)


def test_support_weights_by_hand() -> None:
    assert support_weights(np.array([0.9, 0.7, 0.5])) == pytest.approx([1, 0.25, 0])
    assert support_weights(np.array([0.4, 0.4])).tolist() == [1, 1]


def test_consensus_group_outweighs_better_single_candidate() -> None:
    """Weights 1, 0.64, 0.64, 0.36, 0: the group of three sums to 1.64 within 100 m of its middle,
    the best candidate to 1."""
    positions = at((10, 20), (50, 60), (50.0005, 60), (49.9995, 60), (-30, 0))
    found = find_consensus(np.array([0.9, 0.8, 0.8, 0.7, 0.4]), list("abcde"), positions, 100)
    assert found.members_K.tolist() == [False, True, True, True, False]
    assert (found.leader, found.best_other_score) == (1, 0.9)
    assert haversine_m(at((found.lat, found.lon)), at((50, 60)))[0] < 60


def test_consensus_weak_group_does_not_outweigh_clear_best() -> None:
    """Weights 1 and four times 0.04; not squared, the four would sum to 0.8."""
    positions = at((10, 20), *[(50, 60)] * 4, (-30, 0))
    found = find_consensus(np.array([0.9, 0.5, 0.5, 0.5, 0.5, 0.4]), list("abcdef"), positions, 100)
    assert (found.leader, found.lat, found.best_other_score) == (0, 10, 0.5)


def test_consensus_same_location_agrees_at_any_distance() -> None:
    """Without positions the locations decide: weights 1, 0.77, 0.56, 0, and b sums to 1.33."""
    nowhere = at(*[(None, None)] * 4)
    found = find_consensus(np.array([0.9, 0.85, 0.8, 0.5]), list("abbc"), nowhere, 100)
    assert (found.leader, found.lat, found.lon, found.spread_m) == (1, None, None, 0)
    assert found.best_other_score == 0.9


def test_consensus_member_without_position_adds_only_support() -> None:
    found = find_consensus(
        np.array([0.9, 0.8, 0.2]), list("aab"), at((None, None), (5, 6), (7, 8)), 10
    )
    assert (found.lat, found.lon) == (5, 6)


def test_consensus_over_levels_by_hand() -> None:
    """A coarse candidate (four times the side, so four times the radius) joins two fine ones on its
    ground, 70 m apart, which do not agree with each other; a fine one 200 m off stays out. The
    middle is drawn to the fine ones."""
    d = 1 / DEGREE_M
    positions = at((46, 8), (46 + 35 * d, 8), (46 - 35 * d, 8), (46 + 200 * d, 8), (0, 0))
    scores, names = np.array([0.9, 0.9, 0.9, 0.85, 0.4]), list("abcde")
    scale = np.array([4.0, 1.0, 1.0, 1.0, 1.0])
    found = find_consensus(scores, names, positions, 30, scale)
    assert found.members_K.tolist() == [True, True, True, False, False]
    assert found.scale == 1
    alone = find_consensus(scores, names, positions, 30)
    assert alone.members_K.tolist() == [True, False, False, False, False]
    pair = find_consensus(scores[:2], names[:2], positions[:2], 30, scale[:2])
    assert haversine_m(at((pair.lat, pair.lon)), positions[1])[0] < 1e-3


def test_consensus_of_one_candidate() -> None:
    found = find_consensus(np.array([0.3]), ["a"], at((1, 2)), 10)
    assert (found.leader, found.lat, found.lon, found.best_other_score) == (0, 1, 2, 0.3)


def test_consensus_unlike_neighbour_moves_nothing() -> None:
    """Weight 1 against 0.9 and 0 at 300 m: the median stays at the best candidate."""
    positions = at((46, 8), (46 + 300 / DEGREE_M, 8), (0, 0))
    found = find_consensus(np.array([0.9, 0.85, 0.4]), list("abc"), positions, 400)
    assert found.members_K.tolist() == [True, True, False]
    assert (found.lat, found.lon) == (46, 8)


def test_consensus_equal_neighbours_give_their_middle() -> None:
    d = 1e-4
    lat, lon = geometric_median(at((d, 0), (-d, 0), (0, d), (0, -d)), np.ones(4))
    assert haversine_m(at((lat, lon)), at((0, 0)))[0] < 1e-3


def test_geometric_median_minimises_sum_of_distances() -> None:
    rng = np.random.default_rng(0)
    positions, weight = np.array([46, 8]) + rng.normal(size=(6, 2)) * 1e-3, rng.uniform(0.5, 1, 6)
    found = np.array(geometric_median(positions, weight))

    def cost(point: Doubles) -> float:
        return float((weight * haversine_m(positions, point)).sum())

    steps = 1e-6 * np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
    assert all(cost(found) <= cost(found + step) + 1e-6 for step in steps)


def test_geometric_median_across_180_degrees() -> None:
    positions = at((0, 179.9999), (0, -179.9999), (0.0001, 180), (-0.0001, 180))
    found = find_consensus(np.array([0.9, 0.9, 0.9, 0.9]), list("abcd"), positions, 50)
    assert found.members_K.all()
    assert haversine_m(at((found.lat, found.lon)), at((0, 180)))[0] < 1
    assert found.spread_m == pytest.approx(11.12, abs=0.05)
