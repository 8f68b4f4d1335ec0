"""The maps of a region: known by their bytes, called apart, and read as one file each."""

import shutil
from pathlib import Path

import pytest

from jobs.region.folder import Region
from jobs.region.maps import RegionMap, identify_map, titles_of, with_one_file_each
from jobs.region.settings import AdaptSettings
from tests.sources.mosaics import mosaic, noise, quarters, tiles


def test_map_is_known_again_elsewhere(tmp_path: Path) -> None:
    """A file or a folder of sheets; another map of one name and size is another one."""
    values_BHW = noise(3, 32, 32)
    for at, seed in enumerate((values_BHW, 255 - values_BHW)):
        mosaic(tmp_path / str(at) / "map.tif", seed)
        quarters(tmp_path / str(at) / "sheets", seed)
    shutil.copytree(tmp_path / "0", tmp_path / "moved" / "0")
    for name in ("map.tif", "sheets"):
        one, other, moved = (
            identify_map(str(tmp_path / at / name)) for at in ("0", "1", "moved/0")
        )
        assert one == moved == RegionMap(name=f"0/{name}", sha256=one.sha256)
        assert other.sha256 != one.sha256
        heights = str(tmp_path / "1" / name)
        assert identify_map(str(tmp_path / "0" / name), heights).surface_sha256 == other.sha256


def test_maps_of_one_name_are_called_apart() -> None:
    def titles(*names: str) -> list[str]:
        return titles_of([RegionMap(name=name, sha256=name) for name in names])

    assert titles("a/map.tif", "a/town.tif") == ["map.tif", "town.tif"]
    assert titles("a/map.tif", "b/map.tif", "b/o.tif") == ["a/map.tif", "b/map.tif", "o.tif"]
    assert titles("a/map.tif", "a/map.tif") == ["a/map.tif (1)", "a/map.tif (2)"]


@pytest.mark.parametrize("name", ["map.tif", "map"])
def test_second_map_of_a_name_has_tiles_of_its_own(tmp_path: Path, name: str) -> None:
    """Their keys begin with the map's name; one that is taken gets a number."""
    values_BHW = noise(3, 32, 32)
    first = mosaic(tmp_path / "map.tif", values_BHW)
    quarters(tmp_path / "b" / "map", values_BHW)
    mosaic(tmp_path / "b" / "map.tif", values_BHW)
    settings = AdaptSettings(mosaic=str(tmp_path / "b" / name), out=str(tmp_path / "region"))
    region = Region(out=settings.out)
    found = with_one_file_each(region, settings, [identify_map(first)])
    assert Path(found.mosaic) == tmp_path / "region" / "maps" / "map-1.vrt"
    one, other = tiles(first, tile_pixels=16), tiles(found.mosaic, tile_pixels=16)
    assert {record.key for record in one}.isdisjoint(record.key for record in other)
    assert [record.geotag for record in one] == [record.geotag for record in other]
    alone = with_one_file_each(region, settings)
    assert [record.key for record in tiles(alone.mosaic, tile_pixels=16)] == [
        record.key for record in one
    ]
