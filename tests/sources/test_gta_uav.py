"""GTA-UAV: a drone image's location is its best tile, and damaged pairs are told without stopping
the rest.
"""

import json
import math
from pathlib import Path
from typing import Any

import pytest

from pipeline.core.errors import InputError
from pipeline.core.records import ImageRecord, Rejection
from pipeline.sources.gta_uav import GtaUav

TRAIN, TEST = "cross-area-drone2sate-train.json", "cross-area-drone2sate-test.json"


def touch(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"never opened")


def pair(
    name: str, tiles: dict[str, float], semi: dict[str, float] | None = None
) -> dict[str, Any]:
    """An entry with the fields of the real lists."""
    both = tiles | (semi or {})
    return {
        "drone_img_dir": "drone/images",
        "drone_img_name": name,
        "drone_loc_x_y": [4472.2, 9460.9],
        "sate_img_dir": "satellite",
        "pair_pos_sate_img_list": list(tiles),
        "pair_pos_sate_weight_list": list(tiles.values()),
        "pair_pos_sate_loc_x_y_list": [[1.0, 2.0] for _ in tiles],
        "pair_pos_semipos_sate_img_list": list(both),
        "pair_pos_semipos_sate_weight_list": list(both.values()),
        "pair_pos_semipos_sate_loc_x_y_list": [[1.0, 2.0] for _ in both],
        "drone_metadata": {
            "height": 494.7,
            "drone_roll": -0.3,
            "drone_pitch": 2.0,
            "drone_yaw": 85.0,
            "cam_roll": -90.3,
            "cam_pitch": 2.0,
            "cam_yaw": 85.0,
        },
    }


def miniature(root: Path) -> Path:
    for number in range(1, 6):
        touch(root / f"drone/images/500_0001_000000000{number}.png")
    for tile in ("4_0_6_13", "5_0_12_27", "5_0_13_27", "6_0_0_0"):
        touch(root / f"satellite/{tile}.png")
    train = [
        pair("500_0001_0000000002.png", {"5_0_12_27.png": 0.4, "4_0_6_13.png": 0.7}),
        pair("500_0001_0000000001.png", {"5_0_12_27.png": 0.5}),
    ]
    test = [
        pair("500_0001_0000000003.png", {"5_0_13_27.png": 0.6}, {"4_0_6_13.png": 0.2}),
        pair("500_0001_0000000004.png", {}, {"4_0_6_13.png": 0.2, "6_0_0_0.png": 0.3}),
    ]
    (root / TRAIN).write_text(json.dumps(train))
    (root / TEST).write_text(json.dumps(test))
    return root


def scanned(root: Path, source: GtaUav | None = None) -> tuple[list[ImageRecord], list[Rejection]]:
    found = list((source or GtaUav()).scan(str(root)))
    return [f for f in found if isinstance(f, ImageRecord)], [
        f for f in found if isinstance(f, Rejection)
    ]


def test_gta_uav_location_is_the_tile_of_greatest_weight(tmp_path: Path) -> None:
    records, refused = scanned(miniature(tmp_path))
    assert not refused
    assert [(record.key, record.location) for record in records] == [
        ("train-drone-5_0_12_27-500_0001_0000000001", "5_0_12_27"),
        ("train-drone-4_0_6_13-500_0001_0000000002", "4_0_6_13"),
        ("train-satellite-4_0_6_13-4_0_6_13", "4_0_6_13"),
        ("train-satellite-5_0_12_27-5_0_12_27", "5_0_12_27"),
        ("query-drone-5_0_13_27-500_0001_0000000003", "5_0_13_27"),
        ("gallery-satellite-4_0_6_13-4_0_6_13", "4_0_6_13"),
        ("gallery-satellite-5_0_12_27-5_0_12_27", "5_0_12_27"),
        ("gallery-satellite-5_0_13_27-5_0_13_27", "5_0_13_27"),
        ("gallery-satellite-6_0_0_0-6_0_0_0", "6_0_0_0"),
    ]
    assert all(record.geotag is None for record in records)


def test_gta_uav_pos_semipos_adds_partly_overlapping_images(tmp_path: Path) -> None:
    records, refused = scanned(miniature(tmp_path), GtaUav(pairs="pos_semipos"))
    assert not refused
    queries = {Path(r.path).stem[-1]: r.location for r in records if r.split == "query"}
    assert queries == {"3": "5_0_13_27", "4": "6_0_0_0"}


def test_gta_uav_division_has_its_own_lists(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    with pytest.raises(
        InputError,
        match=r"expected same-area-drone2sate-train\.json or same-area-drone2sate-test\.json",
    ):
        scanned(root, GtaUav(division="same-area"))
    (root / TRAIN).rename(root / "same-area-drone2sate-train.json")
    records, _ = scanned(root, GtaUav(division="same-area"))
    assert {record.split for record in records} == {"train"}


@pytest.mark.parametrize(
    "damage",
    [
        {"pair_pos_sate_weight_list": [0.1, 0.2]},
        {"pair_pos_sate_weight_list": [math.nan]},
        {"pair_pos_sate_weight_list": ["much"]},
        {"pair_pos_sate_weight_list": None},
        {"pair_pos_sate_img_list": [7]},
        {"drone_img_name": None},
        {"drone_img_dir": 3},
    ],
)
def test_gta_uav_damaged_pair_is_refused_alone(tmp_path: Path, damage: dict[str, Any]) -> None:
    root = miniature(tmp_path)
    entries = json.loads((root / TRAIN).read_text())
    entries[1] |= damage
    entries.append("no pair")
    (root / TRAIN).write_text(json.dumps(entries))
    records, refused = scanned(root)
    assert [(r.path, r.reason, r.found.split(":")[0]) for r in refused] == [
        (str(root / TRAIN), "unreadable pair", "entry 1"),
        (str(root / TRAIN), "unreadable pair", "entry 2"),
    ]
    assert [r.location for r in records if r.split == "train"] == ["4_0_6_13", "4_0_6_13"]


def test_gta_uav_pair_with_missing_files_is_refused(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    (root / "satellite/5_0_13_27.png").unlink()
    (root / "drone/images/500_0001_0000000001.png").unlink()
    entries = json.loads((root / TRAIN).read_text())
    entries.append(pair("../../../etc/passwd", {"6_0_0_0.png": 1.0}))
    (root / TRAIN).write_text(json.dumps(entries))
    records, refused = scanned(root)
    assert [(r.reason, r.found) for r in refused] == [
        ("file is missing", f"{TRAIN} names drone/images/../../../etc/passwd"),
        ("file is missing", f"{TRAIN} names drone/images/500_0001_0000000001.png"),
        ("file is missing", f"{TEST} names satellite/5_0_13_27.png"),
    ]
    assert not [r for r in records if r.split == "query"]


def test_gta_uav_misplaced_files_are_refused(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    touch(root / "satellite/Thumbs.db")
    touch(root / "satellite/.DS_Store")
    touch(root / "satellite/level_4/4_0_0_0.png")
    touch(root / "drone/meta_data/500_0001_0000000001.txt")
    _, refused = scanned(root)
    assert [(Path(r.path).name, r.reason) for r in refused] == [
        ("4_0_0_0.png", "wrong folder")
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "said"),
    [("{", "cannot be read as JSON"), ('{"a": 1}', "holds a dict, expected a list")],
)
def test_gta_uav_damaged_list_is_refused(tmp_path: Path, text: str, said: str) -> None:
    (miniature(tmp_path) / TEST).write_text(text)
    with pytest.raises(InputError, match=said):
        scanned(tmp_path)


def test_gta_uav_missing_root_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no folder .*expected GTA-UAV's root"):
        scanned(tmp_path / "nowhere")
