"""The most probable track of a flight: cases by hand, and against an enumeration of all paths."""

from itertools import product

import numpy as np
import pytest

from pipeline.core.arrays import Doubles
from pipeline.core.errors import InputError
from pipeline.core.geo import EARTH_RADIUS_M, haversine_m
from pipeline.locate.track import Motion, TrackPhoto, TrackStart, smooth_track

METRE = 180 / (np.pi * EARTH_RADIUS_M)  # degrees of latitude


def photo(time_s: float, norths_m: list[float], chances: list[float]) -> TrackPhoto:
    """Candidates so many metres north of the equator; the probability left over is that of none."""
    positions = np.array([(north * METRE, 8.0) for north in norths_m]).reshape(-1, 2)
    left = 1 - sum(chances)
    return TrackPhoto(
        time_s=time_s,
        positions_K2=positions,
        log_p_K=np.log(chances),
        log_p_none=float(np.log(left)),
    )


def test_smooth_track_decides_uncertain_photo() -> None:
    """By itself the second photo would be 9 km away; from the first photo to it and on to the
    third, only 100 m can be flown."""
    flight = [
        photo(0, [0, 5000], [0.8, 0.1]),
        photo(10, [9000, 100], [0.5, 0.3]),
        photo(20, [200, 7000], [0.7, 0.2]),
    ]
    found = smooth_track(flight, Motion(max_speed=10.5))
    assert [one.chosen for one in found] == [0, 1, 0]
    assert found[1].probability > 0.5


def test_smooth_track_skips_photo_and_keeps_limit() -> None:
    """In 20 s 150 m can be flown and 5 km cannot, although no photo lies between."""
    flight = [photo(0, [0], [0.9]), photo(10, [9000], [0.5]), photo(20, [5000, 150], [0.6, 0.3])]
    assert [one.chosen for one in smooth_track(flight, Motion(max_speed=10))] == [0, None, 1]


def test_smooth_track_start_decides_first_photo() -> None:
    flight = [photo(0, [0, 3000], [0.7, 0.2])]
    start = TrackStart(lat=2900 * METRE, lon=8.0, radius_m=500)
    assert smooth_track(flight, Motion())[0].chosen == 0
    found = smooth_track(flight, Motion(), start)[0]
    assert found.chosen == 1
    assert found.probability == pytest.approx(0.2 / 0.3)


def test_motion_slack_extends_reach() -> None:
    flight = [photo(0, [0], [0.9]), photo(10, [140], [0.9])]
    assert [one.chosen for one in smooth_track(flight, Motion(max_speed=10))] != [0, 0]
    assert [one.chosen for one in smooth_track(flight, Motion(max_speed=10, slack_m=50))] == [0, 0]


def test_smooth_track_of_one_photo_keeps_probabilities() -> None:
    found = smooth_track([photo(0, [0, 900], [0.5, 0.3])], Motion())[0]
    assert found.p_K == pytest.approx([0.5, 0.3])
    assert found.chosen == 0
    assert found.probability == pytest.approx(0.5)


def test_smooth_track_without_photos_or_candidates() -> None:
    assert smooth_track([], Motion()) == []
    found = smooth_track([photo(0, [], []), photo(1, [5], [0.9])], Motion())
    assert [one.chosen for one in found] == [None, 0]
    assert found[0].probability == pytest.approx(1)


def test_smooth_track_never_chooses_unknown_position() -> None:
    flight = TrackPhoto(
        time_s=0,
        positions_K2=np.full((1, 2), np.nan),
        log_p_K=np.log([0.99]),
        log_p_none=float(np.log(0.01)),
    )
    assert smooth_track([flight], Motion())[0].chosen is None


def test_smooth_track_across_180_degrees() -> None:
    flight = [
        TrackPhoto(
            time_s=10.0 * n,
            positions_K2=np.array([[0, lon]]),
            log_p_K=np.log([0.9]),
            log_p_none=float(np.log(0.1)),
        )
        for n, lon in enumerate((179.9995, -179.9995))
    ]
    assert [one.chosen for one in smooth_track(flight, Motion(max_speed=12))] == [0, 0]


def chains(
    flight: list[TrackPhoto], motion: Motion, start: TrackStart | None
) -> dict[tuple[int | None, ...], float]:
    """Every path that can be flown, with its weight, by enumeration."""
    weights = {}
    for chain in product(*([None, *range(len(one.log_p_K))] for one in flight)):
        weight, last = (
            1.0,
            None if start is None else (flight[0].time_s, start.lat, start.lon, start.radius_m),
        )
        last_number = None
        for number, (one, at) in enumerate(zip(flight, chain, strict=True)):
            weight *= float(np.exp(one.log_p_none if at is None else one.log_p_K[at]))
            if at is None:
                continue
            here: Doubles = one.positions_K2[at]
            if last is not None and (
                last_number is None or number - last_number <= motion.max_gap_photos
            ):
                away = float(haversine_m(np.array(last[1:3]), here))
                way = motion.max_speed * (one.time_s - last[0]) + motion.slack_m + last[3]
                weight *= float(np.exp(motion.gain(np.array(way)))) if away <= way else 0.0
            last, last_number = (one.time_s, float(here[0]), float(here[1]), 0.0), number
        weights[chain] = weight
    return weights


@pytest.mark.parametrize("seed", range(12))
def test_smooth_track_equals_all_paths_enumerated(seed: int) -> None:
    rng = np.random.default_rng(seed)
    flight = []
    for time in np.cumsum(rng.uniform(1, 20, size=5)):
        count = int(rng.integers(0, 4))
        share = rng.dirichlet(np.ones(count + 1))
        flight.append(
            photo(float(time), rng.uniform(0, 600, count).tolist(), share[:count].tolist())
        )
    motion = Motion(
        max_speed=12,
        slack_m=20,
        gallery_positions=40 if seed % 3 else 1,
        spacing_m=50,
        max_gap_photos=1 + seed % 4,
    )
    start = TrackStart(lat=300 * METRE, lon=8.0, radius_m=200) if seed % 2 else None
    weights = chains(flight, motion, start)
    total = sum(weights.values())
    found = smooth_track(flight, motion, start)
    assert tuple(one.chosen for one in found) == max(weights, key=lambda chain: weights[chain])
    for number, one in enumerate(found):
        for at, chance in enumerate(one.p_K):
            with_it = sum(weight for chain, weight in weights.items() if chain[number] == at)
            assert chance == pytest.approx(with_it / total, abs=1e-9)


def test_motion_gain_by_hand() -> None:
    """Of 100 positions on squares of 10 m, 20 lie within a circle of 2,000 square metres: five
    times as likely. A reach beyond all, or within one, gains nothing more."""
    motion = Motion(gallery_positions=100, spacing_m=10)
    ways = np.array([np.sqrt(2000 / np.pi), 1e6, 0.0])
    assert np.exp(motion.gain(ways)) == pytest.approx([5, 1, 100])


def test_smooth_track_near_candidates_beat_none() -> None:
    flight = [photo(10.0 * n, [100.0 * n, 9000], [0.2, 0.2]) for n in range(4)]
    assert [one.chosen for one in smooth_track(flight, Motion())] == [None] * 4
    assert [
        one.chosen for one in smooth_track(flight, Motion(gallery_positions=1000, spacing_m=100))
    ] == [0] * 4


def test_motion_invalid_value_is_refused() -> None:
    with pytest.raises(InputError, match="--elsewhere is 1"):
        Motion(elsewhere=1)
    with pytest.raises(InputError, match="--max-speed is 0"):
        Motion(max_speed=0)
