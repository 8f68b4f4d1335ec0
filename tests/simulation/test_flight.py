"""The spiral flight: University-1652's altitudes and turns, looking at the middle; free flights."""

import itertools
from math import cos, radians, sin, sqrt, tan

import numpy as np
import pytest

from pipeline.simulation.flight import LOWEST_RAY_DEG, FlightPlan, FreeFlight


def test_poses_descend_in_three_turns_of_20_degree_steps() -> None:
    poses = FlightPlan().poses(radius_m=40, first_heading_deg=350)
    assert len(poses) == 54
    assert (poses[0].altitude_m, poses[-1].altitude_m) == pytest.approx((256.0, 121.5))
    assert all(a.altitude_m > b.altitude_m for a, b in itertools.pairwise(poses))
    turned = [(b.heading_deg - a.heading_deg) % 360 for a, b in itertools.pairwise(poses)]
    assert turned == pytest.approx([20.0] * 53)
    assert poses[18].heading_deg == pytest.approx(poses[0].heading_deg)


def test_every_pose_looks_at_the_middle() -> None:
    for pose in FlightPlan(views=7).poses(radius_m=40, first_heading_deg=33):
        ahead = cos(radians(pose.pitch_deg))
        direction = (ahead * sin(radians(pose.heading_deg)), ahead * cos(radians(pose.heading_deg)),
                     sin(radians(pose.pitch_deg)))  # fmt: skip
        to_ground = -pose.altitude_m / direction[2]
        assert pose.x_m + to_ground * direction[0] == pytest.approx(0, abs=1e-6)
        assert pose.y_m + to_ground * direction[1] == pytest.approx(0, abs=1e-6)


def test_first_pose_looking_north_is_in_the_south() -> None:
    # 256 m up, looking 45 degrees down: 256 m to the south.
    [pose] = FlightPlan(views=1, depression_start_deg=45, depression_end_deg=45).poses(radius_m=40)
    assert (pose.x_m, pose.y_m) == pytest.approx((0, -256))
    assert (pose.heading_deg, pose.pitch_deg) == (0, -45)


@pytest.mark.parametrize("radius_m", [10.0, 40.0])
def test_building_fills_the_asked_part_of_the_last_frame(radius_m: float) -> None:
    last = FlightPlan(fill=0.8).poses(radius_m=radius_m)[-1]
    slant = sqrt(last.x_m**2 + last.y_m**2 + last.altitude_m**2)
    assert radius_m / (slant * tan(radians(last.fov_deg) / 2)) == pytest.approx(0.8)


def test_small_scene_is_flown_lower_not_with_a_longer_lens() -> None:
    first = FlightPlan(fov_min_deg=24).poses(radius_m=15)[0]
    assert first.fov_deg == 24
    assert first.altitude_m < 256


def test_fewer_views_spread_over_the_spiral_and_its_headings() -> None:
    plan = FlightPlan(views=6)
    few, all_54 = plan.poses(radius_m=30), FlightPlan().poses(radius_m=30)
    assert few[0] == all_54[0]
    assert few[-1] == all_54[-1]
    assert [pose.heading_deg for pose in few] == pytest.approx([0, 212, 64, 276, 128, 340])


@pytest.mark.parametrize(
    "wrong", [{"views": 0}, {"depression_end_deg": 60.0}, {"altitude_end_m": 300.0}]
)
def test_plan_that_cannot_be_flown_is_rejected(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        FlightPlan(**wrong)  # type: ignore[arg-type]  # one of several fields


def test_free_flight_keeps_within_its_ranges() -> None:
    flight = FreeFlight(views=300, flattest_deg=45.0)
    poses = flight.poses(radius_m=20.0, rng=np.random.default_rng(0))
    assert len({pose.heading_deg // 45 for pose in poses}) == 8
    downs = [-pose.pitch_deg for pose in poses]
    assert 45 <= min(downs) < 50
    assert 85 < max(downs) <= 90
    for pose in poses:
        slant = pose.altitude_m / sin(radians(-pose.pitch_deg))
        half_width = slant * tan(radians(pose.fov_deg / 2)) / 20.0
        assert 0.9 - 1e-6 <= half_width <= 2.0 + 1e-6
        assert -pose.pitch_deg - pose.fov_deg / 2 >= LOWEST_RAY_DEG - 1e-6
        away = slant * cos(radians(-pose.pitch_deg))
        middle = (pose.x_m + away * sin(radians(pose.heading_deg)),
                  pose.y_m + away * cos(radians(pose.heading_deg)))  # fmt: skip
        assert max(map(abs, middle)) <= 0.35 * 20.0 + 1e-6


def test_free_flight_depends_on_its_generator_alone() -> None:
    once, again, other = (
        FreeFlight(views=4).poses(radius_m=20.0, rng=np.random.default_rng(seed))
        for seed in (3, 3, 4)
    )
    assert once == again != other


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"views": 0}, "views is 0"), ({"views": 1, "flattest_deg": 20.0}, "20.0 to 90.0 degrees")],
)
def test_free_flight_that_cannot_be_flown_is_rejected(
    wrong: dict[str, float], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        FreeFlight(**wrong)  # type: ignore[arg-type]
