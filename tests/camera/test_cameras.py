"""The table of cameras against what else is known of them, and flights with a named one."""

import numpy as np
import pytest

from pipeline.camera.cameras import CAMERAS
from pipeline.camera.lens import field_of_view, focal_length_35mm
from pipeline.core.errors import InputError
from pipeline.simulation.over_map.poses import draw_poses
from pipeline.simulation.over_map.settings import CameraRanges, MapFlightSettings


@pytest.mark.parametrize(
    ("name", "equivalent_mm"),
    [("air-2s", 22), ("mavic-3", 24), ("matrice-30", 24), ("mini-3", 24), ("phantom-4", 20),
     ("phantom-4-pro", 24), ("zenmuse-p1-35", 35), ("zenmuse-p1-50", 50)],
)  # fmt: skip
def test_camera_agrees_with_its_35_mm_equivalent(name: str, equivalent_mm: float) -> None:
    """Makers round the equivalent to millimetres."""
    camera = CAMERAS[name]
    found = focal_length_35mm(camera.fov_deg, camera.size)
    assert found == pytest.approx(equivalent_mm, abs=0.9)


@pytest.mark.parametrize(
    ("name", "model", "focal_mm"),
    [("phantom-4-pro", "FC6310", 8.8), ("mavic-3", "L2D-20c", 12.29),
     ("mavic-2-pro", "L1D-20c", 10.26), ("zenmuse-p1-35", "ZenmuseP1", 35.0)],
)  # fmt: skip
def test_camera_agrees_with_its_sensor(name: str, model: str, focal_mm: float) -> None:
    camera = CAMERAS[name]
    by_sensor = field_of_view(camera.size, focal_mm=focal_mm, model=model)
    assert camera.fov_deg == pytest.approx(by_sensor, abs=1.6)


def test_flight_with_a_named_camera_has_its_view() -> None:
    one = MapFlightSettings(mosaic="", out="", camera="zenmuse-p1-35", pitch=(-90.0, -60.0))
    poses = draw_poses(one, np.random.default_rng(0), 5)
    assert {round(pose.fov_deg, 2) for pose in poses} == {54.49}
    assert CameraRanges().fov_range == (45, 65)


def test_camera_unknown_or_beside_a_view_is_refused() -> None:
    with pytest.raises(InputError, match=r"--camera is 'mavic', expected one of air-2s, .*mavic-3"):
        CameraRanges(camera="mavic")
    with pytest.raises(InputError, match=r"--fov is 40\.0 50\.0, expected none with --camera"):
        CameraRanges(camera="mavic-3", fov=(40.0, 50.0))
