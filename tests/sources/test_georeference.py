"""Positions of tiles: centres, corners, metres on the ground, datums, orientation."""

from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import rasterio

from pipeline.sources.maps.georeference import Georeference, parse_crs
from pipeline.sources.maps.tiles import parse_window
from tests.sources.mosaics import (
    NORTH_UP,
    TURNED,
    UTM,
    metres,
    mosaic,
    noise,
    pixels,
    refused,
    tag_of,
    tiles,
)


@pytest.mark.parametrize("affine", [NORTH_UP, TURNED], ids=["north up", "turned and sheared"])
def test_geotags_match_pyproj_within_a_centimetre(tmp_path: Path, affine: Any) -> None:
    root = mosaic(tmp_path / "ortho.tif", noise(3, 150, 230), affine=affine)
    to_wgs84 = pyproj.Transformer.from_crs(UTM, "EPSG:4326", always_xy=True)
    found = tiles(root, tile_pixels=64, overlap=0.25)
    assert len(found) == 5 * 3
    for record in found:
        window, tag = parse_window(record.part), tag_of(record)
        left, top, right, bottom = (
            window.x,
            window.y,
            window.x + window.width,
            window.y + window.height,
        )
        places = [
            ((left + right) / 2, (top + bottom) / 2),
            (left, top),
            (right, top),
            (right, bottom),
            (left, bottom),
        ]
        assert tag.footprint is not None
        for place, said in zip(places, [(tag.lat, tag.lon), *tag.footprint], strict=True):
            lon, lat = to_wgs84.transform(*(affine @ place))
            assert metres((lat, lon), said) < 0.01


@pytest.mark.parametrize(
    ("crs", "affine", "across", "down"),
    [
        (UTM, NORTH_UP, 200, 200),
        # Mercator's metres are twice the ground's at 60 degrees.
        ("EPSG:3857", rasterio.Affine(0.5, 0, 1_000_000, 0, -0.5, 8_399_750), 399, 400),
        # A degree of longitude is half one of latitude there.
        ("EPSG:4326", rasterio.Affine(5e-6, 0, 10, 0, -5e-6, 60.0), 358, 180),
        ("EPSG:2263", rasterio.Affine(1, 0, 980_000, 0, -1, 200_000), 328, 328),  # US survey feet
        # the South Pole in its middle
        ("EPSG:3031", rasterio.Affine(0.5, 0, -128, 0, -0.5, 128), 195, 195),
    ],
)  # fmt: skip
def test_tile_m_is_metres_on_the_ground(
    tmp_path: Path, crs: str, affine: Any, across: int, down: int
) -> None:
    root = mosaic(tmp_path / "ortho.tif", np.ones((1, 512, 512), np.uint8), crs=crs, affine=affine)
    found = tiles(root, tile_m=100.0)
    window = parse_window(found[0].part)
    assert (window.width, window.height) == (across, down)
    footprint = tag_of(found[0]).footprint
    assert footprint is not None
    upper_left, upper_right, lower_right, lower_left = footprint
    for one, other in [
        (upper_left, upper_right),
        (upper_right, lower_right),
        (lower_left, upper_left),
    ]:
        assert metres(one, other) == pytest.approx(100, abs=0.5)


@pytest.mark.parametrize(
    ("crs", "affine"),
    [
        ("EPSG:4326", rasterio.Affine(1e-4, 0, 179.995, 0, -1e-4, -17)),  # runs on to 180.005
        ("EPSG:3857", rasterio.Affine(10, 0, 20_037_008, 0, -10, -1_900_000)),
        ("EPSG:32760", rasterio.Affine(10, 0, 819_000, 0, -10, 8_117_000)),
    ],
)
def test_geotags_across_the_date_line_stay_within_180(
    tmp_path: Path, crs: str, affine: Any
) -> None:
    found = tiles(
        mosaic(tmp_path / "fiji.tif", noise(1, 50, 100), crs=crs, affine=affine), tile_pixels=50
    )
    west, east = (tag_of(record) for record in found)
    assert 179 < west.lon <= 180
    assert -180 <= east.lon < -179
    places = [place for tag in (west, east) for place in tag.footprint or ()]
    assert all(abs(lat) <= 90 and abs(lon) <= 180 for lat, lon in places)
    assert metres((west.lat, west.lon), (east.lat, east.lon)) < 600


def test_tiles_beyond_the_projection_are_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    globe = rasterio.Affine(20_000, 0, -8_000_000, 0, -20_000, 8_000_000)
    root = mosaic(
        tmp_path / "globe.tif",
        noise(1, 800, 800),
        crs="+proj=ortho +lat_0=40 +ellps=WGS84",
        affine=globe,
    )
    found = tiles(root, tile_pixels=100)
    assert 30 < len(found) < 64
    assert f"{64 - len(found)} left out as nowhere on Earth" in capsys.readouterr().err
    assert any(
        tag_of(record).footprint is None for record in found
    )  # its centre is on the disc, a corner is not
    assert all(np.isfinite((tag_of(record).lat, tag_of(record).lon)).all() for record in found)


def test_degrees_are_nan_only_outside_the_projection() -> None:
    crs = parse_crs("+proj=ortho +ellps=WGS84")
    assert crs is not None
    disc = Georeference(crs=crs, affine=rasterio.Affine(1000, 0, 6_370_000, 0, -1000, 0))
    assert np.isnan(disc.degrees(np.array([(0, 0), (100.0, 0)]))[:, 0]).tolist() == [False, True]


# Datums and orientation


def located(crs: str, x: float, y: float, step: float = 0.5) -> tuple[Any, str]:
    return rasterio.Affine(step, 0, x, 0, -step, y), crs


@pytest.mark.parametrize(
    ("affine", "crs", "datum"),
    [
        (*located("EPSG:3828", 300_000, 2_770_000), "Taiwan Datum 1967"),
        (*located("EPSG:3148", 600_000, 1_200_000), "Indian 1960"),
        (*located("EPSG:4214", 116.4, 39.9, 5e-6), "Beijing 1954"),
        (*located("EPSG:2334", 20_500_000, 4_400_000), "Xian 1980"),
        (*located("EPSG:4555", 116.4, 39.9, 5e-6), "New Beijing"),
        (*located("EPSG:4020", 8.0, 47.0, 5e-6), "Not specified"),
        # Tokyo's shift is known in Japan, not in Brazil.
        (*located("EPSG:4301", -50.0, -10.0, 5e-6), "Tokyo"),
    ],
)
def test_unknown_datum_shift_is_refused_or_assumed(
    tmp_path: Path, affine: Any, crs: str, datum: str, capsys: pytest.CaptureFixture[str]
) -> None:
    root = mosaic(tmp_path / "a.tif", noise(1, 64, 64), crs=crs, affine=affine)
    reason, found = refused(root)
    assert reason == "unknown datum shift"
    assert f"no shift from datum {datum}" in found
    assert "--assume-wgs84" in found
    [record] = tiles(root, assume_wgs84=True)
    assert record.geotag is not None
    assert f"WARNING: no shift from datum {datum}" in capsys.readouterr().err


INTL = "+proj=utm +zone=33 +ellps=intl"


@pytest.mark.parametrize(
    ("affine", "crs", "lat", "lon", "said"),
    [
        # The Swiss topographic survey's own figures for the old observatory of Bern.
        (*located("EPSG:2056", 2_600_000, 1_200_000), 46.951082, 7.438632, "EPSG:2056, uint8"),
        (*located("EPSG:21781", 600_000, 200_000), 46.951083, 7.438632, "good to 1.5 m"),
        (*located("EPSG:4490", 116.4, 39.9, 5e-6), 39.9, 116.4, "taken for WGS84: same ellipsoid"),
        (*located("EPSG:4019", 8.0, 47.0, 5e-6), 47.0, 8.0, "taken for WGS84: same ellipsoid"),
        (*located(f"{INTL} +towgs84=-87,-98,-121", 5e5, 4e6), 36.143055, 14.999198, ""),
    ],
)
def test_known_datum_shift_is_applied(
    tmp_path: Path,
    affine: Any,
    crs: str,
    lat: float,
    lon: float,
    said: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    root = mosaic(tmp_path / "a.tif", noise(1, 8, 8), crs=crs, affine=affine)
    [record] = tiles(root)
    corners = tag_of(record).footprint
    assert corners is not None
    assert metres(corners[0], (lat, lon)) < 0.5
    assert said in capsys.readouterr().err


QUARTERS = np.array([[1, 2], [3, 4]], np.uint8).repeat(4, axis=0).repeat(4, axis=1)[None] * 60
"North-west 60, north-east 120, south-west 180, south-east 240, as a map shows them."


@pytest.mark.parametrize(
    ("a", "e", "flip", "said"),
    [
        (0.5, -0.5, (1, 1), "EPSG:32633, uint8"),
        (0.5, 0.5, (1, -1), "south-up: mirrored upside down"),
        (-0.5, -0.5, (-1, 1), "east-left: mirrored left-right"),
        (-0.5, 0.5, (-1, -1), "upside down: turned by 180 degrees"),
    ],
)
def test_mirrored_rasters_are_turned_when_read(
    tmp_path: Path,
    a: float,
    e: float,
    flip: tuple[int, int],
    said: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    x, y = (400_000 if a > 0 else 400_004), (5_800_000 if e < 0 else 5_799_996)
    affine = rasterio.Affine(a, 0, x, 0, e, y)
    stored_1HW = QUARTERS[:, :: flip[1], :: flip[0]]
    [record] = tiles(mosaic(tmp_path / "a.tif", stored_1HW, affine=affine))
    assert said in capsys.readouterr().err
    assert (pixels(record)[:, :, 0] == QUARTERS[0]).all()
    footprint = tag_of(record).footprint
    to_wgs84 = pyproj.Transformer.from_crs(UTM, "EPSG:4326", always_xy=True)
    for corner, (east, north) in zip(
        footprint or (), [(0, 0), (4, 0), (4, -4), (0, -4)], strict=True
    ):
        lon, lat = to_wgs84.transform(400_000 + east, 5_800_000 + north)
        assert metres(corner, (lat, lon)) < 0.01


@pytest.mark.parametrize("degrees", [0, 30, 60, 100, 170, 200, 350])
def test_a_rotated_raster_is_never_mirrored(tmp_path: Path, degrees: int) -> None:
    affine = NORTH_UP @ rasterio.Affine.rotation(degrees)
    columns, rows = Georeference(crs=_utm(), affine=affine).flip((10, 10))
    assert columns == rows
    mirrored = affine @ rasterio.Affine.scale(1, -1)
    columns, rows = Georeference(crs=_utm(), affine=mirrored).flip((10, 10))
    assert columns != rows


def _utm() -> Any:
    crs = parse_crs(UTM)
    assert crs is not None
    return crs


AUX = "<PAMDataset>{}</PAMDataset>"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("ortho.tfw", "0.5\n0\n0\n-0.5\n400000.25\n5799999.75\n"),
        ("ortho.tfw", "0.5\n0\n0\n-0.5\n400000.0\n5800000.0\n"),  # half a pixel: a convention
        ("ortho.tif.aux.xml", AUX.format("<Metadata/>")),
    ],
)
def test_files_beside_a_tiff_may_agree(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    assert len(tiles(mosaic(tmp_path / "ortho.tif", noise(1, 8, 8)))) == 1


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("ortho.tfw", "0.5\n0\n0\n0.5\n400000.25\n5799999.75\n", "its world file places a corner"),
        ("ortho.wld", "1\n0\n0\n-1\n400000.25\n5799999.75\n", "its world file places a corner"),
        (
            "ortho.tif.aux.xml",
            AUX.format("<GeoTransform>300000,0.5,0,5900000,0,-0.5</GeoTransform>"),
            "the file places a corner",
        ),
    ],
)
def test_files_beside_a_tiff_that_contradict_it_are_refused(
    tmp_path: Path, name: str, text: str, said: str
) -> None:
    root = mosaic(tmp_path / "ortho.tif", noise(1, 8, 8))
    (tmp_path / name).write_text(text)
    reason, found = refused(root)
    assert reason == "contradicting coordinates"
    assert said in found
