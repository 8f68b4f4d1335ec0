"""UAV-VisLoc: photos, their tags and their locations."""

from pathlib import Path

import pytest

from pipeline.core.errors import InputError
from pipeline.core.records import GeoTag
from pipeline.sources.visloc import VisLoc
from tests.sources.visloc_miniature import PHOTOS, miniature, scanned, tile, touch


def test_visloc_photo_tags_come_from_the_flight_table(
    tmp_path: Path,
) -> None:
    records, _ = scanned(miniature(tmp_path), tile())
    assert records[0].geotag == GeoTag(lat=30.031, lon=120.009, altitude_m=466.5, heading_deg=270)
    assert records[1].geotag == GeoTag(lat=30.0301, lon=120.0311, altitude_m=470, heading_deg=95.5)
    assert records[2].geotag == GeoTag(lat=30.0, lon=120.06, altitude_m=470)
    assert [record.taken_at for record in records[:3]] == [
        "2018-09-26T10:05:11",
        "2018-09-26T10:05:15",
        None,
    ]


@pytest.mark.parametrize(
    "line",
    [
        "2,01_0002.JPG,,95,120.03,470,1,2,3,4",
        "2,01_0002.JPG,,nan,120.03,470,1,2,3,4",
        "2,01_0002.JPG,,30.03,inf,470,1,2,3,4",
        "2,01_0002.JPG,,30.03,120.03,high,1,2,3,4",
        "2,01_0002.JPG,yesterday,30.03,120.03,470,1,2,3,4",
        "2,01_0002.JPG",
    ],
)
def test_visloc_damaged_line_costs_only_its_photo(tmp_path: Path, line: str) -> None:
    root = miniature(tmp_path)
    table = root / "01/01.csv"
    lines = table.read_text().splitlines()
    table.write_text("\n".join([lines[0], lines[1], line, lines[3]]))
    records, refused = scanned(root, tile())
    assert [Path(record.path).name for record in records if not record.part] == [
        "01_0001.JPG",
        "01_0003.JPG",
    ]
    assert [(Path(r.path).name, r.reason) for r in refused] == [
        ("01.csv", "unreadable tag"), ("01_0002.JPG", "no position")
    ]  # fmt: skip
    assert refused[0].found.startswith("line 3: 2,01_0002.JPG")


def test_visloc_flight_without_angles_has_no_heading(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    (root / "01/01.csv").write_text(
        "\ufefffilename,date,lat,lon,height\n01_0001.jpg,,30.031,120.009,466\n"
    )
    records, _ = scanned(root, tile())
    assert records[0].geotag == GeoTag(lat=30.031, lon=120.009, altitude_m=466)


def test_visloc_missing_tables_are_named(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    (root / "01/01.csv").unlink()
    with pytest.raises(
        InputError, match=r"no .*01/01\.csv; expected the flight's table of positions"
    ):
        scanned(root, tile())
    (root / "satellite_ coordinates_range.csv").unlink()
    with pytest.raises(InputError, match=r"no satellite_coordinates_range\.csv in"):
        scanned(root, tile())
    with pytest.raises(InputError, match=r"no folder .*expected UAV-VisLoc's root"):
        scanned(root / "nowhere", tile())


def test_visloc_misplaced_photos_are_refused(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    touch(root / "01/drone/Thumbs.db")
    touch(root / "01/drone/.DS_Store")
    touch(root / "01/drone/more/01_0004.JPG")
    (root / "09/drone").mkdir(parents=True)
    (root / "09/09.csv").write_text(PHOTOS)
    _, refused = scanned(root, tile())
    assert [(Path(r.path).name, r.reason) for r in refused] == [
        ("01_0004.JPG", "wrong folder")
    ]  # fmt: skip


def test_visloc_wrong_settings_are_refused() -> None:
    with pytest.raises(InputError, match="--tile-pixels is 0"):
        VisLoc(tile_pixels=0)
    with pytest.raises(InputError, match="--overlap is 1"):
        VisLoc(overlap=1)
