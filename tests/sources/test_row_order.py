"""Row order of tile sets: decided by bounds, stated orders, flags; contradictions are refused."""

import json
from pathlib import Path
from typing import Any

import pytest

from pipeline.core.errors import InputError
from pipeline.sources.maps.tile_metadata import parse_metadata, tile_range
from pipeline.sources.maps.web_mercator import row_of_latitude, tile_to_degrees
from pipeline.sources.xyz import Xyz
from tests.sources.tile_sets import folder, mbtiles, records, tile

ZURICH = "8.5390,47.3737,8.5446,47.3779"
X, FROM_NORTH, FROM_SOUTH = 68645, 45899, 85172
"A tile of zoom 17 in Zurich, and the rows of it."
CAPE = "18.40,-33.95,18.45,-33.90"
"Bounds in the southern hemisphere."


def town(path: Path, row: int, **metadata: str) -> str:
    return mbtiles(path, {(17, X, row): tile(1)}, True, **metadata)


@pytest.mark.parametrize(
    ("row", "metadata"),
    [
        (FROM_SOUTH, {}),
        (FROM_NORTH, {"bounds": ZURICH}),
        (FROM_SOUTH, {"bounds": ZURICH}),
        (FROM_SOUTH, {"bounds": ZURICH, "scheme": "xyz"}),
        (FROM_NORTH, {"bounds": ZURICH, "scheme": "tms"}),
        (FROM_NORTH, {"tile_row_type": "osm"}),
        (FROM_NORTH, {"tile_row_type": "XYZ"}),
        (FROM_NORTH, {"scheme": "xyz", "bounds": "-180,-85,180,85"}),
        (FROM_NORTH, {"bounds": "47.3737,8.5390,47.3779,8.5446"}),  # latitude first
        (FROM_SOUTH, {"bounds": "0,0,0,0"}),
        (FROM_SOUTH, {"bounds": "nowhere"}),
    ],
)
def test_mbtiles_row_order_is_decided_by_the_bounds(
    tmp_path: Path, row: int, metadata: dict[str, str]
) -> None:
    root = town(tmp_path / "a.mbtiles", row, **metadata)
    found = records(root)
    assert list(found) == [f"17-{X}-{FROM_NORTH}"]
    record = found[f"17-{X}-{FROM_NORTH}"]
    assert record.geotag is not None
    assert record.geotag.lat == pytest.approx(47.376965, abs=1e-6)
    assert Xyz().read(record) == tile(1)
    assert Xyz().ending(record) == "png"


def test_mbtiles_southern_bounds_decide_too(tmp_path: Path) -> None:
    x, y = 9030, row_of_latitude(14, -33.92)
    for row in (y, 2**14 - 1 - y):
        root = mbtiles(tmp_path / f"{row}.mbtiles", {(14, x, row): tile()}, bounds=CAPE)
        assert list(records(root)) == [f"14-{x}-{y}"]


def test_mbtiles_outside_of_its_bounds_is_refused(tmp_path: Path) -> None:
    root = town(tmp_path / "a.mbtiles", FROM_SOUTH, bounds=CAPE)
    message = r"no tile of zoom 17 lies in the bounds 18.4, -33.95, .* say --rows north or --rows"
    with pytest.raises(InputError, match=message):
        records(root)
    assert list(records(root, rows="south")) == [f"17-{X}-{FROM_NORTH}"]
    assert list(records(root, rows="north")) == [f"17-{X}-{FROM_SOUTH}"]
    assert list(records(root, tms=True)) == [f"17-{X}-{FROM_NORTH}"]


def test_a_decision_by_bounds_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    records(town(tmp_path / "a.mbtiles", FROM_NORTH, bounds=ZURICH))
    printed = capsys.readouterr().err
    assert "rows count from the north, by the bounds 8.539, 47.3737" in printed
    records(town(tmp_path / "b.mbtiles", FROM_SOUTH, bounds=ZURICH))
    assert capsys.readouterr().err == ""


TILE_MAP = """<?xml version="1.0"?><TileMap version="1.0.0"><SRS>{srs}</SRS>
<BoundingBox minx="{0}" miny="{1}" maxx="{2}" maxy="{3}"/>
<TileSets profile="{profile}"><TileSet href="17" order="17"/></TileSets></TileMap>"""


def tile_map(root: Path, *box: float, profile: str = "mercator", srs: str = "EPSG:3857") -> None:
    text = TILE_MAP.format(*box, profile=profile, srs=srs)
    (root / "tilemapresource.xml").write_text(text)


@pytest.mark.parametrize("row", [FROM_NORTH, FROM_SOUTH])
@pytest.mark.parametrize(
    "box",
    [
        (8.539, 47.3737, 8.5446, 47.3779),
        (47.3737, 8.539, 47.3779, 8.5446),  # early gdal2tiles
        (950_557, 6_003_000, 951_181, 6_003_800),  # metres
    ],
)
def test_tile_map_bounds_decide_for_a_folder(
    tmp_path: Path, row: int, box: tuple[float, ...]
) -> None:
    root = folder(tmp_path, f"17/{X}/{row}.png")
    tile_map(tmp_path, *box)
    assert list(records(root)) == [f"17-{X}-{FROM_NORTH}"]


def test_tile_map_without_usable_bounds_counts_from_the_south(tmp_path: Path) -> None:
    root = folder(tmp_path, f"17/{X}/{FROM_SOUTH}.png")
    tile_map(tmp_path, 0, 0, 0, 0)
    assert list(records(root)) == [f"17-{X}-{FROM_NORTH}"]
    (tmp_path / "tilemapresource.xml").write_text("<TileMap")
    assert list(records(root)) == [f"17-{X}-{FROM_SOUTH}"]


@pytest.mark.parametrize(
    ("profile", "srs"), [("geodetic", "EPSG:4326"), ("raster", ""), ("", "EPSG:4326")]
)
def test_a_tile_map_of_another_grid_is_refused(tmp_path: Path, profile: str, srs: str) -> None:
    root = folder(tmp_path, "3/4/2.png")
    tile_map(tmp_path, -10, -10, 10, 10, profile=profile, srs=srs)
    with pytest.raises(InputError, match="expected tiles on the grid of web maps"):
        records(root)


@pytest.mark.parametrize(
    ("values", "row"),
    [
        ({"bounds": ZURICH, "scheme": "tms"}, FROM_NORTH),
        ({"bounds": [8.539, 47.3737, 8.5446, 47.3779]}, FROM_SOUTH),
        ({"scheme": "tms"}, FROM_SOUTH),
        ({"scheme": "xyz"}, FROM_NORTH),
        ([], FROM_NORTH),
    ],
)
@pytest.mark.parametrize("name", ["metadata.json", "tilejson.json"])
def test_json_beside_a_folder_is_compared(tmp_path: Path, name: str, values: Any, row: int) -> None:
    root = folder(tmp_path, f"17/{X}/{row}.png")
    (tmp_path / name).write_text(json.dumps(values))
    assert list(records(root)) == [f"17-{X}-{FROM_NORTH}"]


def test_files_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    root = folder(tmp_path, f"17/{X}/{FROM_NORTH}.png")
    tile_map(tmp_path, 0, 0, 0, 0)
    (tmp_path / "metadata.json").write_text('{"scheme": "xyz"}')
    with pytest.raises(InputError, match="contradict each other in the order of rows"):
        records(root)
    assert list(records(root, rows="north")) == [f"17-{X}-{FROM_NORTH}"]


def test_metadata_of_another_grid_is_refused() -> None:
    with pytest.raises(InputError, match="states crs EPSG:4326"):
        parse_metadata("metadata.json", {"crs": "EPSG:4326"})
    assert parse_metadata("metadata.json", {"crs": "EPSG:3857"}).rows == "auto"


def test_tms_and_rows_from_the_north_are_refused_together() -> None:
    with pytest.raises(InputError, match="--rows is 'north', expected south or auto beside --tms"):
        Xyz(tms=True, rows="north")


@pytest.mark.parametrize("lat", [84.9, 47.3, 0.0, -0.001, -60.0, -85.0])
def test_row_of_latitude_contains_it(lat: float) -> None:
    row = row_of_latitude(12, lat)
    assert tile_to_degrees(12, 0, row + 1)[0] <= lat <= tile_to_degrees(12, 0, row)[0]
    assert row_of_latitude(12, 90) == 0
    assert row_of_latitude(12, -90) == 2**12 - 1


def test_tile_range_over_the_date_line_has_all_columns() -> None:
    assert tile_range(4, (179.0, -20.0, -179.0, -10.0), "north") == (0, 16, 8, 8)
