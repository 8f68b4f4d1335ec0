"""Folders of web map tiles: positions, zooms, row order, other files."""

from pathlib import Path

import pytest

from pipeline.core.errors import InputError
from pipeline.core.records import ImageRecord, Rejection, SkippedFile
from pipeline.sources.base import scan_images
from pipeline.sources.maps.web_mercator import tile_geotag
from pipeline.sources.xyz import Xyz
from tests.sources.tile_sets import folder, mbtiles, records, tile


def test_xyz_folder_tiles_have_positions(tmp_path: Path) -> None:
    root = folder(
        tmp_path,
        "3/4/2.png",
        "3/5/2.JPG",
        "3/5/3.jpeg",
        "3/6/2.webp",
        "metadata.json",
        "leaflet.html",
    )
    found = records(root)
    assert list(found) == ["3-4-2", "3-5-2", "3-5-3", "3-6-2"]
    for location, record in found.items():
        _, x, y = map(int, location.split("-"))
        assert record.geotag == tile_geotag(3, x, y)
        assert record.bytes == len(Xyz().read(record))
    assert [Xyz().ending(record) for record in found.values()] == ["png", "jpg", "jpg", "webp"]
    assert Xyz().read(found["3-4-2"]) == (tmp_path / "3/4/2.png").read_bytes()
    assert (found["3-4-2"].view, found["3-4-2"].split) == ("satellite", "gallery")


def test_xyz_tms_rows_are_flipped(tmp_path: Path) -> None:
    root = folder(tmp_path, "2/1/0.png")
    assert list(records(root, tms=True)) == ["2-1-3"]
    assert records(root, tms=True)["2-1-3"].geotag == tile_geotag(2, 1, 3)


def test_xyz_deepest_zoom_is_packed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = folder(tmp_path, "9/1/1.png", "10/2/2.png", "10/2/3.png")
    assert list(records(root)) == ["10-2-2", "10-2-3"]
    assert "taking zoom 10, the deepest; --zoom takes another of 9" in capsys.readouterr().err
    assert list(records(root, zoom=9)) == ["9-1-1"]
    assert capsys.readouterr().err == ""
    with pytest.raises(InputError, match=r"no tiles of zoom 8 .* it holds zooms 9, 10"):
        records(root, zoom=8)


def test_xyz_several_zooms_are_levels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = ("8/0/0.png", "9/1/1.png", "10/2/2.png", "10/2/3.png", "10/2/3@2x.png")
    root = folder(tmp_path / "tiles", *names)
    levels = {name: one.level for name, one in records(root, zoom=(9, 10)).items()}
    assert levels == {"9-1-1": "z9", "10-2-2": "z10", "10-2-3": "z10"}
    assert [one.level for one in records(root, zoom=10).values()] == ["", ""]
    file = mbtiles(tmp_path / "a.mbtiles", {(9, 1, 1): tile(), (10, 2, 2): tile(1)})
    levels = {name: one.level for name, one in records(file, zoom=(9, 10), rows="north").items()}
    assert levels == {"9-1-1": "z9", "10-2-2": "z10"}
    source = Xyz(zoom=(9, 10), rows="north")
    read = [source.read(one) for one in records(file, zoom=(9, 10), rows="north").values()]
    assert read == [tile(), tile(1)]
    with pytest.raises(InputError, match=r"no tiles of zoom 11 .* it holds zooms 8, 9, 10"):
        records(root, zoom=(10, 11))
    with pytest.raises(InputError, match="--zoom is 9 9, expected each zoom once"):
        Xyz(zoom=(9, 9))


def test_xyz_wrong_folders_and_numbers_are_refused(tmp_path: Path) -> None:
    root = folder(
        tmp_path, "3/4/2.png", "3/8/2.png", "3/4/9.png", "3/west/2.png", "stray.png", "40/1/1.png"
    )
    (tmp_path / "3/4/2.png.aux.xml").write_text("<x/>")
    found = list(Xyz().scan(root))
    reasons = {
        Path(r.path).relative_to(root).as_posix(): r.reason
        for r in found
        if isinstance(r, Rejection)
    }
    assert reasons == {
        "3/8/2.png": "outside of the map",
        "3/4/9.png": "outside of the map",
        "3/west/2.png": "wrong folder",
        "stray.png": "wrong folder",
        "40/1/1.png": "wrong folder",
    }
    assert [r.found for r in found if isinstance(r, Rejection) and r.path.endswith("8/2.png")] == [
        "8, 2; zoom 3 has 0 to 7"
    ]


def test_xyz_root_without_tiles_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no folder and no \.mbtiles file"):
        records(str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match="no tiles in"):
        records(folder(tmp_path, "a/b.png"))
    with pytest.raises(InputError, match="vector tiles"):
        records(folder(tmp_path / "vector", "3/4/2.pbf"))
    with pytest.raises(InputError, match="--zoom is 31"):
        Xyz(zoom=31)


def test_xyz_folder_and_mbtiles_agree(tmp_path: Path) -> None:
    by_folder = records(folder(tmp_path / "xyz", "4/3/2.png", "4/3/3.png"))
    by_file = records(mbtiles(tmp_path / "a.mbtiles", {(4, 3, 13): tile(0), (4, 3, 12): tile(1)}))
    assert {name: record.geotag for name, record in by_folder.items()} == {
        name: record.geotag for name, record in by_file.items()
    }
    assert [Xyz().read(by_folder[name]) for name in by_folder] == [
        Xyz().read(by_file[name]) for name in by_folder
    ]


def test_xyz_retina_tiles_are_read_and_preferred(tmp_path: Path) -> None:
    root = folder(tmp_path, "3/4/2@2x.png", "3/5/2.jpg", "3/5/2@2x.jpg")
    found = list(Xyz().scan(root))
    names = {Path(one.path).name for one in found if isinstance(one, ImageRecord)}
    assert names == {"2@2x.png", "2@2x.jpg"}
    assert [one.reason for one in found if isinstance(one, SkippedFile)] == [
        "tile that is there as @2x"
    ]


def test_xyz_companions_and_other_zooms_are_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = folder(tmp_path, "3/4/2.png", "2/1/1.png", "2/2/1.png")
    for name in ("3/4/2.kml", "3/4/2.png.aux.xml", "3/Thumbs.db", "doc.kml", "leaflet.html"):
        (tmp_path / name).write_text("<x/>")
    assert len(list(scan_images(Xyz(zoom=3), root))) == 1
    assert capsys.readouterr().err == (
        f"{root}: 1 images found, 1 with a position; 7 passed over (tile of zoom 2: 2, "
        "companion file .kml: 2, companion file .xml: 1, companion file .db: 1, "
        "companion file .html: 1)\n"
    )
