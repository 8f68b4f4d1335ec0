"""The renderer against pinhole arithmetic: positions, parallax, facades, occlusion, shadows."""

from math import cos, radians, sin, tan

import numpy as np
import pytest

from pipeline.camera.pose import Pose
from pipeline.simulation.appearance import Day, light_world
from pipeline.simulation.flight import FlightPlan
from pipeline.simulation.render import render_nadir, render_perspective
from pipeline.simulation.scene import Scene, prepare_scene
from pipeline.simulation.shadows import cast_shadows
from pipeline.simulation.world import ByteMap, Facade, World

GREY, RED, GREEN, BLUE = (120, 120, 120), (200, 30, 30), (30, 200, 30), (30, 30, 200)
NOON = Day(sun_elevation_deg=89.9, noise=0.0)
SIDE, MPP = 200, 0.5  # 100 m
Spot = tuple[float, float, float, tuple[int, int, int]]


def world(*spots: Spot, tower: tuple[float, float, float] | None = None) -> World:
    """Grey ground with square spots (x, y, half side, colour), and a tower (x, height, half side)
    with a red roof on the x axis whose walls are blue."""
    texture = np.full((SIDE, SIDE, 3), GREY, np.uint8)
    height, facade, facing = np.zeros((3, SIDE, SIDE), np.float32)
    axis = (np.arange(SIDE) + 0.5) * MPP - SIDE * MPP / 2
    x, y = np.meshgrid(axis, -axis)
    for at_x, at_y, half, colour in spots:
        texture[(np.abs(x - at_x) < half) & (np.abs(y - at_y) < half)] = colour
    if tower:
        built = (np.abs(x - tower[0]) < tower[2]) & (np.abs(y) < tower[2])
        texture[built], height[built], facade[built] = RED, tower[1], 1
    blind = Facade(wall=BLUE, glass=BLUE, window_high=0.0)
    none = np.zeros((SIDE, SIDE), np.uint8)
    return World(
        texture_HW3=texture,
        height_HW=height,
        metres_per_pixel=MPP,
        target_radius_m=20,
        grass_HW=none,
        trees_HW=none,
        facade_HW=facade.astype(np.uint8),
        along_HW=np.zeros_like(height),
        facing_HW=facing,
        facades_K=(blind,),
    )


def scene(*spots: Spot, tower: tuple[float, float, float] | None = None) -> Scene:
    return prepare_scene(world(*spots, tower=tower), NOON)


def where(frame: ByteMap, colour: tuple[int, int, int]) -> np.ndarray:
    """(rows, cols) of the pixels whose strongest channel is the colour's, clearly."""
    channel = int(np.argmax(colour))
    others = [c for c in range(3) if c != channel]
    return np.argwhere(frame[..., channel].astype(int) > 1.6 * frame[..., others].max(axis=2) + 10)


def project(pose: Pose, x: float, y: float, z: float, size: int) -> tuple[float, float]:
    """(row, col) of a point by the pinhole equation."""
    h, p = radians(pose.heading_deg), radians(pose.pitch_deg)
    forward = np.array([sin(h) * cos(p), cos(h) * cos(p), sin(p)])
    right = np.array([cos(h), -sin(h), 0])
    up = np.cross(right, forward)
    d = np.array([x - pose.x_m, y - pose.y_m, z - pose.altitude_m])
    scale = size / 2 / tan(radians(pose.fov_deg) / 2) / (d @ forward)
    return size / 2 - 0.5 - scale * (d @ up), size / 2 - 0.5 + scale * (d @ right)


@pytest.mark.parametrize("heading", [0, 75, 200, 310])
def test_ground_points_are_where_a_pinhole_projects_them(heading: float) -> None:
    view = scene((0, 0, 1.5, RED), (18, 7, 1.5, GREEN))
    pose = FlightPlan(views=3).poses(radius_m=20, first_heading_deg=heading)[1]
    frame = render_perspective(view, pose, size=128)
    assert where(frame, RED).mean(axis=0) == pytest.approx((63.5, 63.5), abs=0.7)
    assert where(frame, GREEN).mean(axis=0) == pytest.approx(project(pose, 18, 7, 0, 128), abs=0.9)


def test_tower_top_is_displaced_by_perspective() -> None:
    pose = FlightPlan().poses(radius_m=20)[40]
    frame = render_perspective(scene(tower=(5, 20, 3)), pose, size=128)
    assert where(frame, RED).mean(axis=0) == pytest.approx(project(pose, 5, 0, 20, 128), abs=1.2)
    base = project(pose, 5, 0, 0, 128)
    assert np.hypot(*(where(frame, RED).mean(axis=0) - base)) > 10


def test_facade_is_below_its_roof_and_hides_ground_behind() -> None:
    north_of_it, south_of_it = (0.0, 10.0, 1.5, GREEN), (0.0, -10.0, 1.5, GREEN)
    looking_north = FlightPlan().poses(radius_m=20)[36]
    assert looking_north.heading_deg == pytest.approx(0)
    behind = render_perspective(scene(north_of_it, tower=(0, 20, 5)), looking_north, size=128)
    before = render_perspective(scene(south_of_it, tower=(0, 20, 5)), looking_north, size=128)
    assert len(where(behind, GREEN)) == 0
    assert len(where(before, GREEN)) > 10
    wall, roof = where(before, BLUE), where(before, RED)
    assert len(wall) > 100
    assert wall[:, 0].mean() > roof[:, 0].max() - 2
    assert wall[:, 0].max() == pytest.approx(project(looking_north, 0, -5, 0, 128)[0], abs=1.5)


def test_nadir_shows_no_facade_and_the_roof_in_place() -> None:
    frame = render_nadir(scene((0, 20, 2, GREEN), tower=(10, 30, 4)), size=100, half_m=25)
    assert len(where(frame, BLUE)) == 0
    rows, cols = where(frame, RED).mean(axis=0)
    assert (rows, cols) == pytest.approx((49.5, 49.5 + 10 * 2), abs=0.6)  # 2 pixels a metre
    assert len(where(frame, RED)) == pytest.approx(16**2, rel=0.1)
    assert where(frame, GREEN).mean(axis=0) == pytest.approx(
        (49.5 - 20 * 2, 49.5), abs=0.6
    )  # north is up


def test_nadir_turn_rotates_the_image_clockwise() -> None:
    frame = render_nadir(scene((0, 20, 2, GREEN)), size=100, half_m=25, turn_deg=90)
    assert where(frame, GREEN).mean(axis=0) == pytest.approx((49.5, 49.5 + 40), abs=0.6)


def test_nadir_shift_moves_the_centre() -> None:
    frame = render_nadir(scene((10, 20, 2, GREEN)), size=100, half_m=25, shift_m=(10, 20))
    assert where(frame, GREEN).mean(axis=0) == pytest.approx((49.5, 49.5), abs=0.6)


@pytest.mark.parametrize(("azimuth", "direction"), [(180, (-1, 0)), (90, (0, -1)), (225, (-1, 1))])
def test_shadow_has_length_height_over_tangent(azimuth: float, direction: tuple[int, int]) -> None:
    day = Day(sun_azimuth_deg=azimuth, sun_elevation_deg=40)
    top = cast_shadows(world(tower=(0, 15, 1)).height_HW, MPP, toward_sun=day.toward_sun())
    ray = np.array(direction) / np.hypot(*direction)
    metres = np.arange(2, 40, MPP)
    pixels = (SIDE / 2 + ray[None, :] * metres[:, None] / MPP).astype(int)
    shaded = metres[top[pixels[:, 0], pixels[:, 1]] > 0.3]
    expected = 15 / tan(radians(40))
    assert shaded.max() == pytest.approx(expected + 1, abs=1.6)  # the far edge of the roof casts it
    back = (SIDE / 2 - ray[None, :] * metres[:, None] / MPP).astype(int)
    assert top[back[:, 0], back[:, 1]].max() < 0.3


def test_shaded_ground_and_shaded_walls_are_darker() -> None:
    day = Day(sun_azimuth_deg=180, sun_elevation_deg=35, noise=0)
    lit = light_world(world(tower=(0, 15, 3)), day).colour_HW3.mean(axis=2)
    assert lit[SIDE // 2 - 16, SIDE // 2] < 0.7 * lit[SIDE // 2 + 16, SIDE // 2]
    made = world(tower=(0, 15, 3))
    made.facing_HW[:] = np.pi  # both walls face south
    sunny = prepare_scene(made, day)
    made.facing_HW[:] = 0
    shady = prepare_scene(made, day)
    pose = FlightPlan().poses(radius_m=20)[36]
    bright, dark = (
        render_perspective(sunny, pose, size=64),
        render_perspective(shady, pose, size=64),
    )
    rows, cols = where(dark, BLUE).T
    assert rows.size > 20
    assert bright[rows, cols, 2].mean() > 1.5 * dark[rows, cols, 2].mean()


def test_noise_depends_on_the_generator_only() -> None:
    noisy = prepare_scene(world(), Day(noise=4.0))
    one, same, other = (
        render_nadir(noisy, size=64, half_m=20, rng=np.random.default_rng(seed))
        for seed in (1, 1, 2)
    )
    assert (one == same).all()
    assert (one != other).any()
    assert one.astype(float).std(axis=(0, 1)) == pytest.approx([4.0] * 3, rel=0.25)


def test_camera_that_sees_the_horizon_is_rejected() -> None:
    level = Pose(x_m=0, y_m=-100, altitude_m=50, heading_deg=0, pitch_deg=-10, fov_deg=40)
    with pytest.raises(ValueError, match="look further down"):
        render_perspective(scene(), level, size=32)


def test_ground_and_roof_below_the_camera_are_no_walls() -> None:
    # Rays near the vertical: a step of one map pixel along them would descend without bound.
    for tower in (None, (0.0, 12.0, 15.0)):
        pose = Pose(x_m=0, y_m=0, altitude_m=60, heading_deg=30, pitch_deg=-90, fov_deg=20)
        frame = render_perspective(scene(tower=tower), pose, size=64)
        middle = frame[24:40, 24:40].reshape(-1, 3)
        assert (middle == middle[0]).all()
        assert len(where(frame, BLUE)) == 0
