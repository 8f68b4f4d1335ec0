"""Flights over a map: photos with tags, true positions, and a rerun that does nothing."""

import csv
import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio.transform import Affine

from pipeline.camera.local_plane import LocalPlane
from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.images.camera_tags import read_tags
from pipeline.images.image_blocks import find_metadata
from pipeline.locate.odometry import read_odometry
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.shards.shard_set import open_shards
from pipeline.simulation.over_map.fly import ODOMETRY, TABLE, TIMES, fly
from pipeline.simulation.over_map.photo import BLOCK_M, is_in_part, photos_over_map
from pipeline.simulation.over_map.poses import spiral_poses
from pipeline.simulation.over_map.settings import MapFlightSettings
from pipeline.simulation.over_map.survey import camera_of_row
from pipeline.sources.maps.mosaic import read_window
from pipeline.sources.maps.tiles import Window
from pipeline.sources.table import Table
from tests.sources.mosaics import mosaic, quarters

SIDE = 700
GROUND = Affine(0.3, 0, 500_000, 0, -0.3, 5_200_000)


def write_map(path: Path, crs: str | None = "EPSG:32632") -> str:
    cells = np.random.default_rng(0).integers(0, 256, (3, SIDE // 10, SIDE // 10), np.uint8)
    with rasterio.open(
        path, "w", driver="GTiff", width=SIDE, height=SIDE, count=3, dtype="uint8", crs=crs,
        transform=GROUND, photometric="RGB",
    ) as opened:  # fmt: skip
        opened.write(cells.repeat(10, axis=1).repeat(10, axis=2))
    return str(path)


def settings(tmp_path: Path, **changes: object) -> MapFlightSettings:
    given = {
        "mosaic": str(tmp_path / "map.tif"), "out": str(tmp_path / "flight"), "photos": 2,
        "height": (30.0, 40.0), "pitch": (-90.0, -70.0), "size": 96, "workers": 0,
    }  # fmt: skip
    return MapFlightSettings(**(given | changes))  # type: ignore[arg-type]


def test_fly_writes_photos_with_tags_and_the_truth(tmp_path: Path) -> None:
    write_map(tmp_path / "map.tif")
    out = fly(settings(tmp_path))
    with (out / "photos.csv").open() as table:
        rows = list(csv.DictReader(table))
    assert [row["path"] for row in rows] == ["photos/00000.jpg", "photos/00001.jpg"]
    for row in rows:
        assert 46.95 < float(row["lat"]) < 46.96
        tags = read_tags(find_metadata((out / row["path"]).read_bytes(), complete=True))
        assert tags.position is None
        assert tags.pitch_deg == pytest.approx(float(row["pitch_deg"]), abs=6)
        assert tags.height_m == pytest.approx(float(row["altitude_m"]), rel=0.2)
        assert tags.heading_deg is not None
        assert tags.focal_px is not None
        assert 75 < tags.focal_px < 120  # 96 pixels by 45 to 65 degrees
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    fly(settings(tmp_path))
    assert before == {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match="other settings"):
        fly(settings(tmp_path, seed=1))


def test_fly_survey_is_a_flight_with_times_and_odometry(tmp_path: Path) -> None:
    """Photos 15 m apart, one camera; the odometry leads from one true camera to the next."""
    write_map(tmp_path / "map.tif")
    one = settings(
        tmp_path, plan="survey", photos=16, every_m=15.0, line_m=30.0, speed=6.0, odometry_error=0.0
    )
    out = fly(one)
    rows, times, steps = (
        list(csv.DictReader((out / name).read_text().splitlines()))
        for name in (TABLE, TIMES, ODOMETRY)
    )
    assert [row["time"] for row in times[:3]] == ["0.000", "2.500", "5.000"]
    assert len({(row["altitude_m"], row["pitch_deg"]) for row in rows}) == 1
    headings = np.array([float(row["heading_deg"]) for row in rows])
    assert set(np.round((headings + 1) / 90).tolist()) == {1, 2, 3}  # forth, across, back
    ways = read_odometry(str(out / ODOMETRY), [row["path"] for row in rows])
    cameras = np.array([camera_of_row(row) for row in rows])
    plane = LocalPlane(lat=float(cameras[0, 0]), lon=float(cameras[0, 1]))
    summed = [(way.east_m - ways[0].east_m, way.north_m - ways[0].north_m) for way in ways]
    assert np.allclose(summed, plane.to_metres(cameras), atol=0.2)
    assert np.linalg.norm(summed[1]) == pytest.approx(15, abs=0.2)
    assert float(steps[1]["error_m"]) == 0.01
    with pytest.raises(InputError, match=r"has no room for photo 900 of a survey"):
        photos_over_map(one, 900, 1)
    with pytest.raises(InputError, match="--plan is 'survey', expected places"):
        settings(tmp_path, plan="survey", views=2)


@pytest.mark.slow
def test_fly_spiral_circles_one_place_downwards(tmp_path: Path) -> None:
    """Three turns around one place, steep where the UAV is high; at 24 m and 20 m away the lowest
    photo looks down by 50 degrees."""
    write_map(tmp_path / "map.tif")
    one = settings(
        tmp_path, plan="spiral", photos=9, height=(24.0, 48.0), pitch=(-80.0, -50.0),
        overhead_m=30.0, part="learn", speed=5.0, odometry_error=0.0,
    )  # fmt: skip
    out = fly(one)
    rows, times, steps = (
        list(csv.DictReader((out / name).read_text().splitlines()))
        for name in (TABLE, TIMES, ODOMETRY)
    )
    assert [row["path"] for row in rows if row["view"] == "satellite"] == ["overhead/00000.jpg"]
    assert len({(row["location"], row["lat"], row["lon"]) for row in rows}) == 1
    photos = [row for row in rows if row["view"] == "drone"]
    turns = np.diff([float(row["heading_deg"]) for row in photos]) % 360
    assert np.allclose(turns, 120, atol=0.1)
    heights = np.array([float(row["altitude_m"]) for row in photos])
    assert np.allclose(heights, np.linspace(48, 24, 9), atol=0.01)
    away = heights / np.tan(np.radians([-float(row["pitch_deg"]) for row in photos]))
    assert np.allclose(away, 24 / np.tan(np.radians(50)), atol=0.05)
    chord = 2 * away[0] * np.sin(np.radians(60))
    assert float(times[2]["time"]) == pytest.approx(2 * chord / 5, abs=0.05)
    assert np.hypot(float(steps[1]["east_m"]), float(steps[1]["north_m"])) == pytest.approx(
        chord, abs=0.2
    )
    with pytest.raises(InputError, match="--plan is 'spiral', expected places with --views"):
        settings(tmp_path, plan="spiral", views=2)


def test_spiral_flies_further_out_where_it_looks_steep(tmp_path: Path) -> None:
    """No photo is steeper than --pitch says, and one lens takes them all."""
    one = settings(tmp_path, plan="spiral", photos=20, height=(20.0, 80.0), pitch=(-60.0, -50.0))
    poses = spiral_poses(one, np.random.default_rng(0))
    pitches = [pose.pitch_deg for pose in poses]
    assert [pitches[0], pitches[-1]] == pytest.approx([-60, -50])
    assert all(-60 - 1e-9 <= pitch <= -50 + 1e-9 for pitch in pitches)
    assert len({pose.fov_deg for pose in poses}) == 1
    down = spiral_poses(
        settings(tmp_path, plan="spiral", pitch=(-90.0, -90.0)), np.random.default_rng(0)
    )
    assert max(abs(pose.x_m) for pose in down) < 1e-9


def test_photo_over_a_surface_model_has_relief(tmp_path: Path) -> None:
    write_map(tmp_path / "map.tif")
    steps = np.zeros((SIDE, SIDE), np.float32)
    steps[:, ::40] = 8.0
    with rasterio.open(
        tmp_path / "surface.tif", "w", driver="GTiff", width=SIDE, height=SIDE, count=1,
        dtype="float32", crs="EPSG:32632", transform=GROUND,
    ) as opened:  # fmt: skip
        opened.write(steps, 1)
    flat = photos_over_map(settings(tmp_path), 0, 1)
    raised = photos_over_map(settings(tmp_path, surface=str(tmp_path / "surface.tif")), 0, 1)
    assert (flat.lat, flat.lon, flat.photos[0].pose) == (
        raised.lat, raised.lon, raised.photos[0].pose,
    )  # fmt: skip
    assert flat.photos[0].jpeg != raised.photos[0].jpeg


def test_photo_over_a_finer_map_shows_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is read at some 0.2 m a pixel instead of 0.075: a photo of 96 pixels shows no more."""
    write_map(tmp_path / "map.tif")
    with rasterio.open(tmp_path / "map.tif") as opened:
        fine = opened.read().repeat(4, axis=1).repeat(4, axis=2)
    mosaic(tmp_path / "fine.tif", fine, crs="EPSG:32632", affine=GROUND @ Affine.scale(0.25))
    sides = list[int]()

    def read(path: str, part: Window, size: tuple[int, int], *given: Any) -> Any:
        sides.append(part.width // size[0])
        return read_window(path, part, size, *given)

    monkeypatch.setattr("pipeline.simulation.over_map.photo.read_window", read)
    names = ("map.tif", "fine.tif")
    coarse, finer = (
        photos_over_map(settings(tmp_path, mosaic=str(tmp_path / name)), 0, 1) for name in names
    )
    assert min(sides[1:]) >= 2
    seen, same = (
        np.asarray(Image.open(io.BytesIO(one.photos[0].jpeg)).convert("L"), float).ravel()
        for one in (coarse, finer)
    )
    assert np.corrcoef(seen, same)[0, 1] > 0.95


def test_fly_pairs_can_be_packed_and_trained_on(tmp_path: Path) -> None:
    """Two places of the blocks to learn from: two photos each, less the last one, and their pieces
    of the map."""
    write_map(tmp_path / "map.tif")
    out = fly(settings(tmp_path, photos=3, views=2, overhead_m=40.0, part="learn"))
    packed = str(tmp_path / "shards")
    pack(Table(), PackingSettings(root=str(out / "photos.csv"), out=packed, workers=0))
    counts = {
        (shard.split, shard.view): shard.samples for shard in open_shards(packed).manifest.shards
    }
    assert counts == {(Split.TRAIN, View.DRONE): 3, (Split.TRAIN, View.SATELLITE): 2}
    with (out / "photos.csv").open() as table:
        rows = list(csv.DictReader(table))
    at = {(row["location"], row["lat"], row["lon"]) for row in rows}
    assert len(at) == 2
    assert len({row["heading_deg"] for row in rows if row["view"] == "drone"}) == 3
    piece = np.asarray(Image.open(out / "overhead" / "00000.jpg"))
    assert piece.shape[0] == pytest.approx(40 / 0.3, abs=1)


def test_parts_of_a_map_do_not_touch() -> None:
    """One block in five is held out, and its places keep a fifth of its side from its border."""
    axis = np.arange(2, 5 * BLOCK_M, 16.0)
    points = [(x, y) for x in axis for y in axis]
    learn = np.array([one for one in points if is_in_part("learn", *one)])
    held = np.array([one for one in points if is_in_part("held-out", *one)])
    assert len(learn) / len(points) == pytest.approx(0.8, abs=0.01)
    assert len(held) / len(points) == pytest.approx(0.2 * 0.6**2, rel=0.1)
    apart_2 = np.abs(learn[:, None] - held[None]).max(axis=2).min(axis=0)
    assert apart_2.min() >= 0.2 * BLOCK_M


def test_fly_held_out_pairs_are_a_test_set(tmp_path: Path) -> None:
    write_map(tmp_path / "map.tif")
    out = fly(settings(tmp_path, photos=1, overhead_m=40.0, part="held-out"))
    with (out / "photos.csv").open() as table:
        assert [(row["view"], row["split"]) for row in csv.DictReader(table)] == [
            ("drone", "query"), ("satellite", "gallery"),
        ]  # fmt: skip


def test_fly_over_sheets_sees_the_one_map(tmp_path: Path) -> None:
    """Four files in a folder, with their heights: the photos of the one file, bit by bit."""
    write_map(tmp_path / "map.tif")
    with rasterio.open(tmp_path / "map.tif") as opened:
        values = opened.read()
    heights = values[:1].astype(np.float32) / 50
    mosaic(tmp_path / "dsm.tif", heights, crs="EPSG:32632", affine=GROUND)
    quarters(tmp_path / "sheets", values, GROUND, crs="EPSG:32632")
    quarters(tmp_path / "heights", heights, GROUND, crs="EPSG:32632")
    one = settings(tmp_path, surface=str(tmp_path / "dsm.tif"))
    of_sheets = replace(one, mosaic=str(tmp_path / "sheets"), surface=str(tmp_path / "heights"))
    expected = fly(one)
    found = fly(replace(of_sheets, out=str(tmp_path / "again")))
    for path in (TABLE, "photos/00000.jpg", "photos/00001.jpg"):
        assert (found / path).read_bytes() == (expected / path).read_bytes()
    assert sorted(path.name for path in found.iterdir()) == ["flight.json", "photos", "photos.csv"]


@pytest.mark.slow
def test_fly_over_an_unusable_map_is_refused(tmp_path: Path) -> None:
    write_map(tmp_path / "map.tif", crs=None)
    with pytest.raises(InputError, match="cannot be flown over"):
        fly(settings(tmp_path))
    write_map(tmp_path / "map.tif")
    with pytest.raises(InputError, match="is too small: no place"):
        photos_over_map(settings(tmp_path, height=(900.0, 900.0)), 0, 1)
