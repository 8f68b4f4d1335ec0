"""DenseUAV: positions come from its tables, by letters or by order, and a damaged line costs no
image.
"""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.errors import InputError
from pipeline.core.records import GeoTag, ImageRecord, Rejection
from pipeline.sources.denseuav import DenseUAV, parse_line
from pipeline.sources.text_tables import Unreadable

TRAIN_LINES = """\
train/satellite/000001/H80.tif E120.387 N30.32 94.6
train/satellite/000001/H80_old.tif E120.387 N30.32 94.6
train/drone/000001/H90.JPG E120.388 N30.33 104.5
"""


def touch(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"never opened")


def miniature(root: Path) -> Path:
    for height in (80, 90, 100):
        for folder in (
            "train/drone/000001",
            "test/query_drone/002256",
            "test/gallery_drone/002256",
        ):
            touch(root / folder / f"H{height}.JPG")
        for folder in (
            "train/satellite/000001",
            "test/query_satellite/002256",
            "test/gallery_satellite/002256",
        ):
            touch(root / folder / f"H{height}.tif")
            touch(root / folder / f"H{height}_old.tif")
    (root / "Dense_GPS_train.txt").write_text(TRAIN_LINES)
    (root / "Dense_GPS_test.txt").write_text(
        "test/gallery_satellite/002256/H80.tif 30.31 120.36 91\n"
    )
    return root


def scanned(root: Path) -> tuple[dict[str, ImageRecord], list[Rejection]]:
    found = list(DenseUAV().scan(str(root)))
    records = {
        Path(r.path).relative_to(root).as_posix(): r for r in found if isinstance(r, ImageRecord)
    }
    return records, [f for f in found if isinstance(f, Rejection)]


def test_denseuav_gives_split_view_location_and_key(tmp_path: Path) -> None:
    records, refused = scanned(miniature(tmp_path))
    assert not refused
    assert len(records) == 27
    assert len({record.key for record in records.values()}) == 27
    query = records["test/query_drone/002256/H80.JPG"]
    assert (query.split, query.view, query.location) == ("query", "drone", "002256")
    gallery = records["test/gallery_satellite/002256/H100_old.tif"]
    assert (gallery.split, gallery.view, gallery.location) == ("gallery", "satellite", "002256")
    assert records["train/drone/000001/H90.JPG"].split == "train"


def test_denseuav_position_of_own_line_else_of_location(tmp_path: Path) -> None:
    records, _ = scanned(miniature(tmp_path))
    assert records["train/drone/000001/H90.JPG"].geotag == GeoTag(
        lat=30.33, lon=120.388, altitude_m=104.5
    )
    assert records["train/drone/000001/H80.JPG"].geotag == GeoTag(
        lat=30.32, lon=120.387, altitude_m=80.0
    )
    assert records["train/satellite/000001/H80.tif"].geotag == GeoTag(lat=30.32, lon=120.387)
    assert records["train/satellite/000001/H100.tif"].geotag == GeoTag(lat=30.32, lon=120.387)
    assert records["test/query_drone/002256/H100.JPG"].geotag == GeoTag(
        lat=30.31, lon=120.36, altitude_m=100.0
    )


def test_denseuav_without_tables_has_no_geotags(tmp_path: Path) -> None:
    for table in miniature(tmp_path).glob("*.txt"):
        table.unlink()
    records, refused = scanned(tmp_path)
    assert not refused
    assert all(record.geotag is None for record in records.values())


@pytest.mark.parametrize(
    "line",
    [
        "test/gallery_satellite/002256/H80.tif E120.36 N95 91",
        "test/gallery_satellite/002256/H80.tif Enan N30.31 91",
        "test/gallery_satellite/002256/H80.tif inf 120.36 91",
        "test/gallery_satellite/002256/H80.tif nan 30.31 120.36 91",
        "test/gallery_satellite/002256/H80.tif E120.36 E30.31 91",
        "test/gallery_satellite/002256/H80.tif E120.36 30.31 91",
        "test/gallery_satellite/002256/H80.tif 30.31 120.36",
        "test/gallery_satellite/002256/H80.tif 30.31 120.36 high",
        "\x00\x01 no line at all",
    ],
)
def test_denseuav_damaged_line_costs_only_its_tag(tmp_path: Path, line: str) -> None:
    root = miniature(tmp_path)
    (root / "Dense_GPS_test.txt").write_text(f"test/x/009999/H80.tif 1 2 3\n\n{line}\n")
    records, refused = scanned(root)
    assert len(records) == 27
    assert records["test/query_drone/002256/H80.JPG"].geotag is None
    assert [(r.path, r.reason) for r in refused] == [
        (str(root / "Dense_GPS_test.txt"), "unreadable tag")
    ]
    assert refused[0].found.startswith("line 3: ")


def test_denseuav_table_without_readable_line_is_refused(tmp_path: Path) -> None:
    (miniature(tmp_path) / "Dense_GPS_ALL.txt").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match=r"Dense_GPS_ALL\.txt has no line that can be read"):
        scanned(tmp_path)


def test_denseuav_misplaced_files_are_refused(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    touch(root / "train/drone/000001/Thumbs.db")
    touch(root / "train/drone/000001/inner/H80.JPG")
    touch(root / "train/drone/.DS_Store")
    (root / "train/drone/000777").mkdir()
    records, refused = scanned(root)
    assert len(records) == 27
    assert sorted(r.reason for r in refused) == ["wrong folder"]


def test_denseuav_missing_root_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no folder .*expected DenseUAV's root"):
        scanned(tmp_path / "nowhere")


@given(st.floats(-90, 90), st.floats(-180, 180), st.booleans())
def test_parse_line_with_letters_in_either_order(lat: float, lon: float, swapped: bool) -> None:
    words = [f"{'S' if lat < 0 else 'N'}{abs(lat)!r}", f"{'W' if lon < 0 else 'E'}{abs(lon)!r}"]
    path, tag = parse_line(
        " ".join(["a b/000001/H80.tif", *(reversed(words) if swapped else words), "94.6"])
    )
    assert (path, tag) == ("a b/000001/H80.tif", GeoTag(lat=lat, lon=lon, altitude_m=94.6))


def test_parse_line_latitude_beyond_pole_is_unreadable() -> None:
    with pytest.raises(Unreadable, match="latitude 95 is not between"):
        parse_line("a/1/H80.tif 95 12 3")


def test_denseuav_lines_that_contradict_each_other_give_none(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    (root / "Dense_GPS_ALL.txt").write_text(
        "train/drone/000001/H90.JPG E120.388 N30.43 104.5\n"
        "train/satellite/000001/H80.tif E120.387 N30.32 94.6\n"
    )
    records, refused = scanned(root)
    assert [(Path(r.path).name, r.found[:8]) for r in refused] == [
        ("Dense_GPS_ALL.txt", "line 1: ")
    ]
    assert records["train/drone/000001/H90.JPG"].geotag is None
    assert records["train/satellite/000001/H80.tif"].geotag is not None
