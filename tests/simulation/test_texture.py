"""Worlds from images: which files are used, skipped and rejected, and the error messages."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.core.errors import InputError
from pipeline.simulation.appearance import Day, light_world
from pipeline.simulation.texture import RADIUS_FRACTION, textured_world, usable_textures


def save_image(
    path: Path, width: int = 96, height: int = 96, colour: tuple[int, int, int] = (90, 140, 80)
) -> Path:
    Image.new("RGB", (width, height), colour).save(path)
    return path


def test_image_becomes_flat_ground_of_its_size(tmp_path: Path) -> None:
    ground = textured_world(str(save_image(tmp_path / "a.png", 120, 96)), metres_per_pixel=0.3)
    assert ground.extent_m == pytest.approx(96 * 0.3)
    assert ground.target_radius_m == pytest.approx(RADIUS_FRACTION * 96 * 0.3)
    assert not ground.height_HW.any()
    assert np.abs(ground.texture_HW3.astype(int) - (90, 140, 80)).max() <= 1
    assert ground.light_is_baked


def test_photo_keeps_its_light_and_shadow_in_summer(tmp_path: Path) -> None:
    ground = textured_world(str(save_image(tmp_path / "a.png")), metres_per_pixel=0.3)
    assert (light_world(ground, Day(sun_elevation_deg=20)).colour_HW3 == ground.texture_HW3).all()


def test_season_changes_green_but_not_grey(tmp_path: Path) -> None:
    lawn = textured_world(str(save_image(tmp_path / "a.png")), metres_per_pixel=0.3)
    road = textured_world(
        str(save_image(tmp_path / "b.png", colour=(120, 120, 120))), metres_per_pixel=0.3
    )
    winter = Day(season="winter")
    assert (light_world(lawn, winter).colour_HW3 != lawn.texture_HW3).any()
    assert (light_world(road, winter).colour_HW3 == road.texture_HW3).all()


def test_height_map_is_used_at_any_resolution(tmp_path: Path) -> None:
    path = save_image(tmp_path / "quad.jpg", 96, 96)
    heights = np.zeros((48, 48))
    heights[:24] = 12.0
    np.save(tmp_path / "quad.height.npy", heights)
    ground = textured_world(str(path), metres_per_pixel=0.3)
    half = ground.height_HW.shape[0] // 2
    assert (ground.height_HW[: half - 1] == 12).all()
    assert (ground.height_HW[half + 1 :] == 0).all()


def test_height_map_of_another_shape_is_rejected(tmp_path: Path) -> None:
    path = save_image(tmp_path / "quad.jpg")
    np.save(tmp_path / "quad.height.npy", np.zeros(7))
    with pytest.raises(InputError, match=r"shape \(7,\); expected two dimensions"):
        textured_world(str(path), metres_per_pixel=0.3)


def test_files_that_are_no_images_are_skipped_and_counted(tmp_path: Path) -> None:
    (tmp_path / "below").mkdir()
    save_image(tmp_path / "b.png")
    save_image(tmp_path / "below" / "a.jpg")
    save_image(tmp_path / "tiny.png", 20, 200)
    (tmp_path / "notes.txt").write_text("no image")
    (tmp_path / "broken.jpg").write_bytes(b"no image either")
    intact = save_image(tmp_path / "cut.jpg", 400, 400).read_bytes()
    (tmp_path / "cut.jpg").write_bytes(intact[: len(intact) // 2])
    usable, skipped = usable_textures(str(tmp_path))
    assert [Path(path).name for path in usable] == ["b.png", "a.jpg"]
    assert skipped == 4


def test_missing_and_empty_folders_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"no folder .*nowhere; expected a folder of overhead images"
    ):
        usable_textures(str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match="holds 0 files and none is an image"):
        usable_textures(str(tmp_path))


def test_truncated_image_is_named_in_the_error(tmp_path: Path) -> None:
    path = save_image(tmp_path / "cut.png", 400, 400)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match=r"cut\.png cannot be decoded"):
        textured_world(str(path), metres_per_pixel=0.3)
