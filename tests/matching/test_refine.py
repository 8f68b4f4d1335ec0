"""A photo of a made map is found where it was taken; one of another map is not."""

import numpy as np
import pytest

from pipeline.camera.local_plane import LocalPlane
from pipeline.camera.map_window import Tile, compose_window
from pipeline.camera.pose import PartialPose
from pipeline.core.arrays import Pixels
from pipeline.core.geo import haversine_m
from pipeline.matching.gate import holds
from pipeline.matching.ground_fit import is_camera_view
from pipeline.matching.photo_features import prepare_photo
from pipeline.matching.refine import prepare_window, refine
from tests.matching.made_maps import SIZE, error_m, made_map, photo_of, window_of


@pytest.mark.parametrize(
    "pose",
    [
        PartialPose(),
        PartialPose(fov_deg=55.0),
        PartialPose(heading_deg=33.0, pitch_deg=-59.0, height_m=62.0, fov_deg=55.0),
    ],
    ids=["nothing known", "lens known", "pose known"],
)
def test_refine_locates_a_photo_within_a_metre(pose: PartialPose) -> None:
    window = window_of(made_map(0))
    found = refine(prepare_photo(photo_of(window), pose), [prepare_window(window)])
    assert found is not None
    assert holds(found)
    assert error_m(found) < 1
    assert found.heading_deg == pytest.approx(30, abs=1)
    assert len(found.footprint) == 4
    assert found.ellipse.major_m >= found.ellipse.minor_m > 0
    if pose.fov_deg is None:
        assert found.camera is None
    else:
        assert found.camera is not None
        [[lat, lon]] = LocalPlane(lat=47.0, lon=8.0).to_degrees(np.array([[-20.0, -35.0]]))
        assert haversine_m(np.array(found.camera[:2]), np.array([lat, lon])) < 2
        assert found.camera[2] == pytest.approx(60, abs=2)


def test_refine_on_another_map_does_not_hold() -> None:
    photo = prepare_photo(photo_of(window_of(made_map(0))))
    found = refine(photo, [prepare_window(window_of(made_map(1)))])
    assert found is None or not holds(found)


def test_refine_against_a_wrong_heading_is_refused() -> None:
    window = window_of(made_map(0))
    photo = prepare_photo(photo_of(window), PartialPose(heading_deg=200.0))
    assert refine(photo, [prepare_window(window)]) is None


def test_refine_of_a_plain_photo_finds_nothing() -> None:
    plain = np.full((240, 320, 3), 90, np.uint8)
    assert refine(prepare_photo(plain), [prepare_window(window_of(made_map(0)))]) is None


def test_camera_view_is_neither_mirrored_nor_of_the_sky() -> None:
    north_up_33 = np.array([[0.3, 0, -48], [0, -0.3, 36], [0, 0, 1]])
    assert is_camera_view(north_up_33, SIZE)
    assert not is_camera_view(np.diag([-1.0, 1.0, 1.0]) @ north_up_33, SIZE)
    horizon_33 = north_up_33 + np.array([[0, 0, 0], [0, 0, 0], [0, -1 / 120, 0]])
    assert not is_camera_view(horizon_33, SIZE)


def test_compose_window_puts_tiles_where_they_lie() -> None:
    plane = LocalPlane(lat=47.0, lon=8.0)

    def tile(west: float, colour: int) -> Tile:
        corners = np.array([[west, 20], [west + 20, 20], [west + 20, 0], [west, 0]], np.float64)
        pixels_HW3 = np.full((40, 40, 3), colour, np.uint8)

        def read() -> Pixels:
            tiles_read.append(west)
            return pixels_HW3

        return Tile(read=read, footprint=plane.to_degrees(corners), metres_per_pixel=0.5)

    tiles_read: list[float] = []
    # The tile between the others adds nothing.
    window = compose_window(plane, [tile(-20, 50), tile(-10, 90), tile(0, 200)], 20, 0.5)
    assert tiles_read == [-20, 0]
    assert window.pixels_HW3.shape == (80, 80, 3)
    assert window.pixels_HW3[20, 20, 0] == 50
    assert window.pixels_HW3[20, 60, 0] == 200
    assert window.shown_HW[60].max() == 0  # south of the tiles
    assert window.to_ground_33 @ [80, 0, 1] == pytest.approx([20, 20, 1])
