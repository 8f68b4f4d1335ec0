"""Tracks through candidates with errors of their own, by odometry, and in flight: by hand, and
against an enumeration of all paths."""

import math
from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.camera.local_plane import LocalPlane
from pipeline.core.arrays import Doubles
from pipeline.locate.movement import Places
from pipeline.locate.odometry import Travelled
from pipeline.locate.track import (
    Motion,
    SmoothedPhoto,
    TrackPhoto,
    TrackStart,
    filter_track,
    smooth_track,
)

PLANE = LocalPlane(lat=46.0, lon=8.0)
GALLERY = Motion(max_speed=12, gallery_positions=400, spacing_m=50)
Path = tuple[int | None, ...]


def photo(
    time_s: float,
    places_m: list[tuple[float, float]],
    chances: list[float],
    errors_m: list[float] | None = None,
    cameras_m: list[tuple[float, float]] | None = None,
    travelled: Travelled | None = None,
) -> TrackPhoto:
    """Candidates so many metres east and north of 46 N, 8 E."""

    def places(metres: list[tuple[float, float]], errors: list[float]) -> Places:
        spread = np.array(errors, np.float64)
        return Places(
            positions_N2=PLANE.to_degrees(np.array(metres, np.float64).reshape(-1, 2)),
            slack_N=spread,
            covariance_N22=spread[:, None, None] ** 2 * np.eye(2),
        )

    errors = errors_m or [0.0] * len(places_m)
    ground = places(places_m, errors)
    return TrackPhoto(
        time_s=time_s,
        positions_K2=ground.positions_N2,
        log_p_K=np.log(np.array(chances, np.float64)),
        log_p_none=math.log(1 - sum(chances)),
        ground=ground,
        camera=places(cameras_m, errors) if cameras_m else None,
        travelled=travelled,
    )


def way(east_m: float, north_m: float = 0.0, variance_m2: float = 0.0) -> Travelled:
    return Travelled(chain=0, east_m=east_m, north_m=north_m, variance_m2=variance_m2)


def chosen(found: list[SmoothedPhoto]) -> list[int | None]:
    return [one.chosen for one in found]


def move_weight(one: tuple[TrackPhoto, int], other: tuple[TrackPhoto, int], m: Motion) -> float:
    """The factor of a move between two candidates, worked out on its own: metres in a plane."""
    (a, i), (b, j) = one, other
    grounds = [PLANE.to_metres(p.positions_K2[k : k + 1])[0] for p, k in (one, other)]
    points, ahead = grounds, a.ahead_m + b.ahead_m
    assert a.ground is not None
    assert b.ground is not None
    places = [a.ground, b.ground]
    cameras = [a.camera, b.camera]
    if a.camera is not None and b.camera is not None:
        places, ahead = [a.camera, b.camera], 0.0
        points = [
            PLANE.to_metres(c.positions_N2[k : k + 1])[0] for c, k in ((a.camera, i), (b.camera, j))
        ]
    else:
        for camera, ground, k in zip(cameras, grounds, (i, j), strict=True):
            if camera is not None:
                ahead += float(
                    np.linalg.norm(PLANE.to_metres(camera.positions_N2[k : k + 1])[0] - ground)
                )
    moved: Doubles = points[1] - points[0]
    if a.travelled and b.travelled and a.travelled.chain == b.travelled.chain:
        off = moved - (
            b.travelled.east_m - a.travelled.east_m,
            b.travelled.north_m - a.travelled.north_m,
        )
        covariance = places[0].covariance_N22[i] + places[1].covariance_N22[j]
        covariance = covariance + (b.travelled.variance_m2 - a.travelled.variance_m2) * np.eye(2)
        ahead_squared = sum(
            float(np.sum((PLANE.to_metres(c.positions_N2[k : k + 1])[0] - g) ** 2))
            for c, g, k in zip(cameras, grounds, (i, j), strict=True)
            if c is not None and places[0] is a.ground
        )
        covariance = covariance + ahead_squared / 2 * np.eye(2)
        density = math.exp(-off @ np.linalg.solve(covariance, off) / 2)
        density /= 2 * math.pi * math.sqrt(np.linalg.det(covariance))
        return density * m.gallery_positions * m.spacing_m**2
    reach = m.max_speed * (b.time_s - a.time_s) + m.slack_m + ahead
    reach += float(places[0].slack_N[i] + places[1].slack_N[j])
    if np.linalg.norm(moved) > reach:
        return 0.0
    within = max(math.pi * (reach / m.spacing_m) ** 2, 1.0)
    return max(m.gallery_positions / within, 1.0)


def all_paths(flight: list[TrackPhoto], m: Motion) -> dict[Path, float]:
    """Every path with its weight; positions within a kilometre, where the plane is exact."""
    weights: dict[Path, float] = {}
    for path in product(*([None, *range(len(one.log_p_K))] for one in flight)):
        weight = math.prod(
            math.exp(one.log_p_none if at is None else one.log_p_K[at])
            for one, at in zip(flight, path, strict=True)
        )
        taken = [(n, at) for n, at in enumerate(path) if at is not None]
        for (n, at), (later, to) in pairwise(taken):
            if later - n <= m.max_gap_photos:
                weight *= move_weight((flight[n], at), (flight[later], to), m)
        weights[path] = weight
    return weights


def random_flight(seed: int) -> list[TrackPhoto]:
    """Tiles and tight places, some with cameras, with odometry that has gaps."""
    rng = np.random.default_rng(seed)
    flight, chain, sums = [], 0, np.zeros(3)
    for time in np.cumsum(rng.uniform(2, 20, size=5)):
        count = int(rng.integers(0, 4))
        share = rng.dirichlet(np.ones(count + 1))[:count].tolist()
        metres = rng.uniform(0, 300, (count, 2))
        ahead = rng.uniform(-60, 60, (count, 2))
        chain += int(rng.uniform() < 0.3)
        sums = sums + np.array([*rng.uniform(-60, 60, 2), rng.uniform(1, 400)])
        flight.append(
            photo(
                float(time), metres.tolist(), share, rng.choice([2.0, 25.0], count).tolist(),
                (metres + ahead).tolist() if rng.uniform() < 0.6 and count else None,
                Travelled(chain=chain, east_m=sums[0], north_m=sums[1], variance_m2=sums[2])
                if rng.uniform() < 0.6 else None,
            )
        )  # fmt: skip
    return flight


@pytest.mark.parametrize("seed", range(10))
def test_track_with_errors_equals_all_paths(seed: int) -> None:
    """Smoother over all paths, filter over those of each beginning of the flight."""
    flight = random_flight(seed)
    motion = Motion(
        max_speed=12, gallery_positions=400, spacing_m=50, slack_m=5, max_gap_photos=1 + seed % 4
    )
    weights = all_paths(flight, motion)
    total, smoothed = sum(weights.values()), smooth_track(flight, motion)
    assert tuple(chosen(smoothed)) == max(weights, key=lambda path: weights[path])
    for number, one in enumerate(smoothed):
        for at, chance in enumerate(one.p_K):
            share = sum(w for path, w in weights.items() if path[number] == at) / total
            assert chance == pytest.approx(share, abs=1e-4)  # a plane, not a sphere
    for number, one in enumerate(filter_track(flight, motion)):
        weights = all_paths(flight[: number + 1], motion)
        total = sum(weights.values())
        assert one.chosen == max(weights, key=lambda path: weights[path])[-1]
        for at, chance in enumerate(one.p_K):
            share = sum(w for path, w in weights.items() if path[-1] == at) / total
            assert chance == pytest.approx(share, abs=1e-4)  # a plane, not a sphere


def test_wrong_refined_place_between_right_ones_is_dropped() -> None:
    """Alone it is sure; 10 s from its neighbours, 4 km away, it is impossible."""
    flight = [
        photo(0, [(0, 0)], [0.98], [2]),
        photo(10, [(4000, 0), (60, 20)], [0.95, 0.02], [2, 25]),
        photo(20, [(200, 0)], [0.98], [2]),
    ]
    assert chosen(smooth_track(flight, GALLERY)) == [0, 1, 0]


def test_refined_neighbours_decide_an_unrefined_photo() -> None:
    """Three tiles are as likely; two tight places leave the one between them. With the slack of
    tiles at both ends, a tile 200 m aside could be reached too."""
    tiles = [(70.0, 150.0), (70.0, 0.0), (3000.0, 0.0)]
    middle = photo(10, tiles, [0.2, 0.2, 0.2], [25] * 3)
    flight = [photo(0, [(0, 0)], [0.9], [2]), middle, photo(20, [(140, 0)], [0.9], [2])]
    found = smooth_track(flight, GALLERY)
    assert chosen(found) == [0, 1, 0]
    assert found[1].probability > 0.9
    loose = [photo(n * 20, [(140 * n, 0)], [0.9], [25]) for n in range(2)]
    unsure = smooth_track([loose[0], middle, loose[1]], GALLERY)[1]
    assert unsure.probability < 0.6


def test_odometry_tells_lookalike_streets_apart() -> None:
    """Two parallel streets 100 m apart; by speed both can be flown, and the one to the south looks
    a little better. 80 m to the north-east were measured from the last sure photo."""
    sure = photo(0, [(0, 0)], [1 - 1e-9], [2], travelled=way(0))
    looks = [(80.0, 50.0), (80.0, -50.0)]
    by_speed = [sure, photo(20, looks, [0.4, 0.5], [25, 25])]
    measured = [sure, photo(20, looks, [0.4, 0.5], [25, 25], travelled=way(78, 48, 25))]
    assert chosen(smooth_track(by_speed, GALLERY)) == [0, 1]
    found = smooth_track(measured, GALLERY)
    assert chosen(found) == [0, 0]
    # Both factors have one covariance, 25^2 + 2^2 + 25; off by (2, 2) and by (2, -98).
    ratio = 0.4 / 0.5 * math.exp((98**2 - 2**2) / 2 / (625 + 4 + 25))
    [right, wrong] = found[1].p_K.tolist()
    assert right / wrong == pytest.approx(ratio, rel=0.01)


def test_odometry_error_adds_up_over_skipped_photos() -> None:
    """80 m off with an error of 30 m in each of four steps is likely; in one step it is not."""
    ends = [photo(0, [(0, 0)], [0.5], [2], travelled=way(0))]
    off = [(180.0, 0.0)]
    near, far = (
        smooth_track(
            [*ends, photo(30, off, [0.5], [2], travelled=way(100, 0, steps * 900))], GALLERY
        )
        for steps in (1, 4)
    )
    assert near[1].probability < far[1].probability


def test_camera_that_turns_stays_in_reach() -> None:
    """The camera flies 20 m and looks back: its ground is 180 m off, its own places are known."""
    flight = [
        photo(0, [(100, 0)], [0.9], [2], [(0, 0)]),
        photo(2, [(-80, 0)], [0.9], [2], [(20, 0)]),
    ]
    assert chosen(smooth_track(flight, GALLERY)) == [0, 0]
    blind = [photo(0, [(100, 0)], [0.9], [2]), photo(2, [(-80, 0)], [0.9], [2])]
    assert None in chosen(smooth_track(blind, GALLERY))


def test_online_does_not_know_later_photos() -> None:
    """The first photo takes the better tile until the second shows that it was the other one."""
    flight = [photo(0, [(0, 0), (3000, 0)], [0.5, 0.3]), photo(10, [(3050, 0)], [0.9])]
    assert chosen(smooth_track(flight, GALLERY)) == [1, 0]
    assert chosen(filter_track(flight, GALLERY)) == [0, 0]
    assert filter_track([], GALLERY) == []


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), slack_m=st.floats(0, 60), begun=st.booleans())
def test_track_without_extras_is_that_of_one_slack(seed: int, slack_m: float, begun: bool) -> None:
    """Half of the slack at each candidate is the slack of every move, as it was; and the last photo
    of a flight is known in flight as well as afterwards."""
    plain = [
        photo(one.time_s, PLANE.to_metres(one.positions_K2).tolist(), np.exp(one.log_p_K).tolist())
        for one in random_flight(seed)
    ]
    halves = [
        photo(
            one.time_s, PLANE.to_metres(one.positions_K2).tolist(), np.exp(one.log_p_K).tolist(),
            [slack_m / 2] * len(one.log_p_K),
        )
        for one in plain
    ]  # fmt: skip
    start = TrackStart(lat=46.0, lon=8.0, radius_m=900.0) if begun else None
    motion = Motion(max_speed=12, gallery_positions=400, spacing_m=50, slack_m=slack_m)
    old, new = smooth_track(plain, motion), smooth_track(halves, GALLERY)
    assert chosen(old) == chosen(new)
    for one, other in zip(old, new, strict=True):
        assert one.p_K == pytest.approx(other.p_K, abs=1e-9)
    last, online = (
        smooth_track(halves, GALLERY, start)[-1],
        filter_track(halves, GALLERY, start)[-1],
    )
    assert last.chosen == online.chosen
    assert last.p_K == pytest.approx(online.p_K, abs=1e-9)


def test_start_with_odometry_is_a_place_of_its_circle() -> None:
    """The start is known to 50 m, a place 100 m east of it is where odometry ended."""
    start = TrackStart(lat=46.0, lon=8.0, radius_m=50.0)
    flight = [
        photo(0, [], [], travelled=way(0)),
        photo(9, [(100, 0), (0, 100)], [0.3, 0.4], [9, 9], travelled=way(100, 0, 9)),
    ]
    assert chosen(smooth_track(flight, GALLERY, start)) == [None, 0]
