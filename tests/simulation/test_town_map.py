"""The town as a map: three GeoTIFFs of one ground, the same for the same seed, flown over."""

from pathlib import Path

import numpy as np
import pytest
import rasterio

from pipeline.core.errors import InputError
from pipeline.simulation.over_map.fly import fly
from pipeline.simulation.over_map.settings import MapFlightSettings, TownMapSettings
from pipeline.simulation.over_map.town_map import ANOTHER_DAY, MAP, SURFACE, make_town_map


def settings(out: Path, seed: int = 0) -> TownMapSettings:
    return TownMapSettings(out=str(out), side=200.0, resolution=1.0, seed=seed)


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_town_map(settings(tmp_path_factory.mktemp("town") / "town"))


def test_town_map_shows_one_ground_on_two_days(town: Path, tmp_path: Path) -> None:
    opened = {name: rasterio.open(town / name) for name in (MAP, ANOTHER_DAY, SURFACE)}
    assert {(one.shape, one.transform, one.crs) for one in opened.values()} == {
        ((200, 200), opened[MAP].transform, rasterio.CRS.from_epsg(32632))
    }
    first, second = opened[MAP].read(), opened[ANOTHER_DAY].read()
    assert np.abs(first.astype(int) - second).mean() > 3
    heights = opened[SURFACE].read(1)
    assert heights.min() == 0
    assert 5 < heights.max() < 100
    for one in opened.values():
        one.close()
    again = make_town_map(settings(tmp_path / "again"))
    for name in (MAP, ANOTHER_DAY, SURFACE):
        assert (town / name).read_bytes() == (again / name).read_bytes()


def test_town_map_resumes_and_refuses_another_seed(town: Path) -> None:
    before = (town / MAP).stat().st_mtime_ns
    make_town_map(settings(town))
    assert (town / MAP).stat().st_mtime_ns == before
    with pytest.raises(InputError, match="seed 0 instead of 1"):
        make_town_map(settings(town, seed=1))


def test_town_map_is_flown_over_on_another_day(town: Path, tmp_path: Path) -> None:
    out = fly(
        MapFlightSettings(
            mosaic=str(town / ANOTHER_DAY), surface=str(town / SURFACE), out=str(tmp_path / "out"),
            photos=1, height=(30.0, 40.0), pitch=(-90.0, -80.0), size=64, workers=0,
        )
    )  # fmt: skip
    assert len(list((out / "photos").iterdir())) == 1
