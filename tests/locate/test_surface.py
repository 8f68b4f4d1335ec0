"""Heights of a surface model on their way to matching."""

from pathlib import Path

import numpy as np
import pytest
from rasterio.transform import Affine
from rasterio.warp import transform

from jobs.encoding.localizer import Localizer, with_localizer, write_localizer
from jobs.stages.matching import HEIGHT_PIXEL_M, height_reader
from jobs.stages.settings import LocateSettings
from pipeline.camera.local_plane import LocalPlane
from pipeline.core.errors import InputError
from pipeline.matching.relief import Relief
from tests.matching.made_maps import MadeMap
from tests.sources.mosaics import UTM, mosaic

EAST_M, NORTH_M, SIDE_PX = 500_000.0, 5_200_000.0, 100
"Of the model's upper left corner, and its side in pixels of 2 m."


@pytest.fixture
def surface(tmp_path: Path) -> str:
    """Ground at 400 m, a roof of 12 m north-east of the middle, and a gap in the south-west."""
    height_HW = np.full((1, SIDE_PX, SIDE_PX), 400, np.float32)
    height_HW[0, 30:50, 50:70] = 412
    height_HW[0, 90:, :10] = -9999
    affine = Affine(2, 0, EAST_M, 0, -2, NORTH_M)
    return mosaic(tmp_path / "dsm.tif", height_HW, affine=affine, nodata=-9999)


def plane_at(east_m: float, north_m: float) -> LocalPlane:
    """At metres from the model's upper left corner."""
    [lon], [lat] = transform(UTM, "EPSG:4326", [EAST_M + east_m], [NORTH_M + north_m])
    return LocalPlane(lat=lat, lon=lon)


def test_height_reader_is_north_up_around_the_position(surface: str) -> None:
    relief = height_reader(surface)(plane_at(100, -100), 60.0)
    assert relief is not None
    assert relief.metres_per_pixel == HEIGHT_PIXEL_M
    places_N2 = np.array([[10.0, 20.0], [-10.0, 20.0], [10.0, -20.0], [35.0, 35.0], [50.0, 20.0]])
    assert relief.at(places_N2) == pytest.approx([412, 400, 400, 412, 400], abs=0.01)


def test_height_reader_fills_gaps_and_knows_its_end(surface: str) -> None:
    read = height_reader(surface)
    beside_gap = read(plane_at(20, -180), 30.0)
    assert beside_gap is not None
    assert np.unique(np.round(beside_gap.height_HW)).tolist() == [400]
    assert read(plane_at(5000, 5000), 60.0) is None


def test_height_reader_of_no_surface_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.tif cannot be read .*check --surface"):
        height_reader(str(tmp_path / "none.tif"))
    nowhere = mosaic(tmp_path / "nowhere.tif", np.ones((1, 8, 8), np.float32), crs=None)
    with pytest.raises(InputError, match="has no coordinate system"):
        height_reader(nowhere)


def test_windows_have_the_heights_of_their_ground() -> None:
    made = MadeMap()
    windows = made.windows()
    [key] = made.gallery.keys[:1].tolist()
    place = (*made.gallery.positions_N2[0].tolist(), key)
    [flat] = windows.around([place], 1)
    assert flat.relief is None
    relief = Relief(height_HW=np.zeros((4, 4), np.float32), metres_per_pixel=50.0)
    asked = list[tuple[LocalPlane, float]]()

    def read(plane: LocalPlane, half_m: float) -> Relief:
        asked.append((plane, half_m))
        return relief

    windows = made.windows()
    windows.heights = read
    [window] = windows.around([place], 1)
    assert window.relief is relief
    assert [plane for plane, _ in asked] == [window.plane]
    assert np.abs(window.ground_N2).max() <= asked[0][1]


def test_localizer_names_the_surface_model_if_it_is_there(
    surface: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    index = str(tmp_path / "index")
    settings = LocateSettings(photos=("a.jpg",), index=index, out="where.geojson")
    write_localizer(index, Localizer(checkpoint="../a", shards="../b", surface=surface))
    assert with_localizer(settings).surface == surface
    Path(surface).unlink()
    assert with_localizer(settings).surface is None
    assert "dsm.tif of" in capsys.readouterr().err


def test_localizer_of_a_moved_region_finds_what_lies_in_it(surface: str, tmp_path: Path) -> None:
    region = tmp_path / "region"
    (region / "maps").mkdir(parents=True)
    Path(surface).rename(region / "maps" / "dsm.tif")
    noted = Localizer(checkpoint="../a", shards="../b", surface="../maps/dsm.tif")
    write_localizer(str(region / "index"), noted)
    index = region.rename(tmp_path / "moved") / "index"
    settings = LocateSettings(photos=("a.jpg",), index=str(index), out="where.geojson")
    found = with_localizer(settings).surface
    assert found is not None
    assert Path(found).resolve() == (tmp_path / "moved" / "maps" / "dsm.tif").resolve()
