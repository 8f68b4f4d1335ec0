"""SUES-200: both forms give the same records; images of one name from four heights stay apart."""

from collections import Counter
from pathlib import Path

import fsspec
import pytest

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import ImageRecord, Rejection, Split, View
from pipeline.sources.sues200 import HEIGHTS, TRAIN_LOCATIONS, Sues200


def touch(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"never opened")


def prepared(root: Path) -> Path:
    """Location 0001 is for training, 0008 for testing."""
    for height in HEIGHTS:
        training, testing = root / f"Training/{height}", root / f"Testing/{height}"
        touch(training / "satellite/0001/0.png")
        touch(testing / "query_satellite/0008/0.png")
        for name in ("0.jpg", "1.JPG"):
            touch(training / "drone/0001" / name)
            touch(testing / "query_drone/0008" / name)
        for location in ("0001", "0008"):
            touch(testing / "gallery_satellite" / location / "0.png")
            for name in ("0.jpg", "1.JPG"):
                touch(testing / "gallery_drone" / location / name)
    return root


def downloaded(root: Path) -> Path:
    for location in ("0001", "0008"):
        touch(root / "satellite-view" / location / "0.png")
        for height in HEIGHTS:
            touch(root / "drone_view_512" / location / str(height) / "0.jpg")
            touch(root / "drone_view_512" / location / str(height) / "1.JPG")
    return root


def scanned(
    root: Path | str, source: Sues200 | None = None
) -> tuple[list[ImageRecord], list[Rejection]]:
    found = list((source or Sues200()).scan(str(root)))
    return [f for f in found if isinstance(f, ImageRecord)], [
        f for f in found if isinstance(f, Rejection)
    ]


def test_sues200_both_forms_give_the_same_keys(tmp_path: Path) -> None:
    one, refused = scanned(prepared(tmp_path / "prepared"))
    other, refused_too = scanned(downloaded(tmp_path / "downloaded"))
    assert refused == refused_too == []
    assert sorted(record.key for record in one) == sorted(record.key for record in other)
    counted = Counter((record.split.value, record.view.value, record.location) for record in one)
    assert counted == {
        ("train", "drone", "0001"): 8, ("train", "satellite", "0001"): 1,
        ("query", "drone", "0008"): 8, ("query", "satellite", "0008"): 1,
        ("gallery", "drone", "0001"): 8, ("gallery", "satellite", "0001"): 1,
        ("gallery", "drone", "0008"): 8, ("gallery", "satellite", "0008"): 1,
    }  # fmt: skip


def test_sues200_height_is_only_in_drone_keys(tmp_path: Path) -> None:
    records, _ = scanned(downloaded(tmp_path))
    keys = {record.key for record in records}
    assert len(keys) == len(records)
    assert {f"train-drone-0001-{height}-0" for height in HEIGHTS} <= keys
    assert {"train-satellite-0001-0", "gallery-satellite-0001-0", "query-satellite-0008-0"} <= keys
    assert all(record.geotag is None for record in records)


@pytest.mark.parametrize("make", [prepared, downloaded])
def test_sues200_one_height_keeps_all_satellite_images(tmp_path: Path, make: object) -> None:
    assert callable(make)
    records, refused = scanned(make(tmp_path), Sues200(heights=(200,)))
    assert not refused
    assert {record.variant for record in records if record.view == View.DRONE} == {"200"}
    assert sum(record.view == View.SATELLITE for record in records) == 4


def test_sues200_unknown_height_is_refused() -> None:
    with pytest.raises(
        InputError, match="--heights is 175, expected one or more of 150 200 250 300"
    ):
        Sues200(heights=(175,))
    with pytest.raises(InputError, match="--heights is nothing"):
        Sues200(heights=())


def test_sues200_train_list_has_120_of_200_locations() -> None:
    assert len(TRAIN_LOCATIONS) == 120
    assert {f"{number:04d}" for number in range(1, 201)} >= TRAIN_LOCATIONS
    assert "0008" not in TRAIN_LOCATIONS


def test_sues200_misplaced_images_are_refused(tmp_path: Path) -> None:
    root = downloaded(tmp_path)
    touch(root / "drone_view_512/0001/175/0.jpg")
    touch(root / "drone_view_512/0001/150/deeper/0.jpg")
    touch(root / "drone_view_512/0001/150/Thumbs.db")
    touch(root / "drone_view_512/0001/150/.DS_Store")
    touch(root / "satellite-view/stray.png")
    (root / "satellite-view/0099").mkdir()
    records, refused = scanned(root)
    assert len(records) == 36
    assert {(Path(r.path).relative_to(root).as_posix(), r.reason) for r in refused} == {
        ("drone_view_512/0001/175/0.jpg", "wrong folder"),
        ("drone_view_512/0001/150/deeper/0.jpg", "wrong folder"),
        ("satellite-view/stray.png", "wrong folder"),
    }


def test_sues200_odd_names_and_links_are_read(tmp_path: Path) -> None:
    root = tmp_path / "root"
    for number in range(55):
        touch(tmp_path / "elsewhere" / f"大学 {number}.jpeg")
    (root / "Training/150/drone").mkdir(parents=True)
    (root / "Training/150/drone/0001").symlink_to(tmp_path / "elsewhere")
    records, refused = scanned(root)
    assert not refused
    assert len({record.key for record in records}) == 55
    assert {record.split for record in records} == {Split.TRAIN}


def test_sues200_is_read_from_other_storage() -> None:
    fsspec.filesystem("memory").pipe("/sues/satellite-view/0001/0.png", b"x")
    records, _ = scanned("memory://sues")
    assert [record.key for record in records] == [
        "train-satellite-0001-0",
        "gallery-satellite-0001-0",
    ]
    assert storage.read_bytes(records[0].path) == b"x"


def test_sues200_missing_and_empty_root_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no folder .*expected SUES-200's root"):
        scanned(tmp_path / "nowhere")
    with pytest.raises(InputError, match="no images below"):
        scanned(tmp_path)
