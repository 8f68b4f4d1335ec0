"""UAV images laid on the ground: by footprint and by pose, and what stays as it was taken."""

from typing import Any

import numpy as np
import pytest

from pipeline.camera.framing import FRAME_PX
from pipeline.camera.ground import footprint, ground_to_photo, photo_to_ground
from pipeline.camera.lens import focal_length_35mm
from pipeline.camera.local_plane import LocalPlane
from pipeline.camera.overhead import ASSUMED_FOV_DEG, overhead_view
from pipeline.camera.pose import Pose
from pipeline.camera.warp import north_up, warp
from pipeline.core.arrays import Pixels

SIDE = 400
POSE = Pose.looking_at_zero(altitude_m=120, heading_deg=70, pitch_deg=-50, fov_deg=ASSUMED_FOV_DEG)


def ground(side_m: float = 600.0) -> Pixels:
    """A north-up picture of the ground, a pixel each metre: a red disc 40 m north of zero, a green
    one 40 m east of it, on grey squares."""
    at = np.arange(side_m) - side_m / 2 + 0.5
    east, north = np.meshgrid(at, -at)
    squares = 90 + 40 * (((east // 15) + (north // 15)) % 2)
    image = np.repeat(squares[..., None], 3, 2).astype(np.uint8)
    image[np.hypot(east, north - 40) < 9] = (255, 0, 0)
    image[np.hypot(east - 40, north) < 9] = (0, 255, 0)
    return image


def photo() -> Pixels:
    picture = ground()
    to_photo = ground_to_photo(POSE, (SIDE, SIDE)) @ np.linalg.inv(north_up(1.0, -300, 300))
    return warp(picture, to_photo, (SIDE, SIDE))


def disc(image: Pixels, channel: int) -> tuple[float, float]:
    """Middle of the pixels that are of one pure colour, as shares of the width and height."""
    others = [one for one in range(3) if one != channel]
    pure = (image[..., channel] > 180) & (image[..., others].max(-1) < 80)
    rows, columns = np.nonzero(pure)
    assert len(rows) > 20
    return float(columns.mean() + 0.5) / len(image), float(rows.mean() + 0.5) / len(image)


def tag(kind: str) -> dict[str, Any]:
    if kind == "footprint":
        plane = LocalPlane(lat=46.5, lon=8.0)
        found = plane.to_degrees(footprint(POSE, (SIDE, SIDE)))
        angles = {"lat": 46.5, "lon": 8.0, "footprint": found.tolist()}
    return {"lat": 46.5, "lon": 8.0, "heading_deg": 70.0, "pitch_deg": -50.0, "footprint": None}
    focal = focal_length_35mm(ASSUMED_FOV_DEG, (1, 1))
    return angles | {"focal_35mm": focal, "roll_deg": 0.0} if kind == "focal length" else angles


@pytest.mark.parametrize("kind", ["footprint", "angles", "focal length"])
def test_overhead_view_shows_the_ground_north_up(kind: str) -> None:
    framed = overhead_view(photo(), tag(kind))
    assert framed.shape == (FRAME_PX, FRAME_PX, 3)
    to_ground = photo_to_ground(POSE, (SIDE, SIDE))
    ends = [to_ground @ [x, SIDE / 2, 1] for x in (0, SIDE)]
    width_m = float(np.linalg.norm(np.subtract(*(end[:2] / end[2] for end in ends))))
    assert disc(framed, 0) == pytest.approx((0.5, 0.5 - 40 / width_m), abs=0.01)
    assert disc(framed, 1) == pytest.approx((0.5 + 40 / width_m, 0.5), abs=0.01)


@pytest.mark.parametrize(
    "geotag",
    [
        None,
        {},
        {"heading_deg": 70.0},
        {"pitch_deg": -5.0, "heading_deg": 70.0},  # sky in view
        {"pitch_deg": float("nan")},
        {"pitch_deg": "steep"},
        {"pitch_deg": -90.0, "heading_deg": 0.0},  # overhead already
        {"footprint": [[1.0, 2.0]]},
        {"footprint": "everywhere"},
        {"footprint": [[46.5, 8.0]] * 4},
        {"footprint": [[46.5, 8.0], [46.501, 8.001], [46.501, 8.0], [46.5, 8.001]]},  # crossed
        {"footprint": [[float("inf"), 2.0]] * 4},
    ],
)
def test_overhead_view_keeps_images_of_unknown_pose(geotag: dict[str, Any] | None) -> None:
    image = photo()
    assert overhead_view(image, geotag) is image
