"""Where pixels of a mosaic lie on the Earth. In: pixel places, an affine transform, a coordinate
system. Out: WGS84.

Pixel places are (x, y) from the upper left corner of the upper left pixel.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import rasterio
from rasterio._err import CPLE_BaseError  # what transform raises; rasterio gives it no public name
from rasterio.crs import CRS
from rasterio.errors import CRSError
from rasterio.warp import transform

from pipeline.core.records import GeoTag
from pipeline.sources.maps.tiles import Window

Array = npt.NDArray[np.float64]
WGS84 = CRS.from_epsg(4326)
EQUATOR_M, POLE_M = 6378137.0, 6356752.314245  # the ellipsoid's half axes [WGS84]
# pixels either side of the place measured: enough against rounding, little against the map's
# distortion
BASELINE_PIXELS = 10.0
MAX_COORDINATE = 1e12
"""In any unit: beyond it nothing is on Earth, and PROJ goes round Web Mercator's equator turn by
turn to find out."""


@dataclass(frozen=True, kw_only=True)
class Georeference:
    """A mosaic's place on the Earth."""

    crs: CRS
    "Of the coordinates that `affine` gives."
    affine: rasterio.Affine
    "Pixel places to coordinates; turned and sheared ones are fine."

    def degrees(self, places_N2: Array) -> Array:
        """(lat, lon) of pixel places, (N, 2), WGS84: latitude within +-90, longitude within +-180.

        NaN where a place lies outside of what the projection can show, or its coordinate system has
        no place on Earth.
        """
        x, y = places_N2.T
        a, b, c, d, e, f = self.affine[:6]
        xs, ys = a * x + b * y + c, d * x + e * y + f
        near = (np.abs(xs) < MAX_COORDINATE) & (np.abs(ys) < MAX_COORDINATE)  # false of a NaN
        lon, lat = _to_wgs84(self.crs, np.where(near, xs, 0.0), np.where(near, ys, 0.0))
        lon, lat = np.where(near, lon, np.nan), np.where(near, lat, np.nan)
        lon = np.where(
            np.abs(lon) > 180, (lon + 180) % 360 - 180, lon
        )  # mosaics may run on beyond the date line
        return np.stack([np.clip(lat, -90, 90), lon], axis=1)

    def geotags(self, windows: Iterable[Window]) -> list[GeoTag | None]:
        """For each window its centre and its four corners; None where the centre is nowhere on
        Earth.
        """
        places = [(window.centre, *window.corners) for window in windows]
        tags: list[GeoTag | None] = []
        for centre, *corners in (
            self.degrees(np.array(places, float).reshape(-1, 2)).reshape(-1, 5, 2).tolist()
        ):
            if np.isnan(centre).any():
                tags.append(None)
                continue
            footprint = (
                None if np.isnan(corners).any() else tuple((lat, lon) for lat, lon in corners)
            )
            tags.append(GeoTag(lat=centre[0], lon=centre[1], footprint=footprint))
        return tags

    def ground_pixel(self, place: tuple[float, float]) -> tuple[float, float]:
        """Width and height in metres, on the ground, of the pixel at a place; NaN where `degrees`
        is.

        Measured between places a few pixels apart on the ellipsoid: true metres whatever the map's
        unit and scale are.
        """
        x, y = place
        around = np.array(
            [
                (x - BASELINE_PIXELS, y),
                (x + BASELINE_PIXELS, y),
                (x, y - BASELINE_PIXELS),
                (x, y + BASELINE_PIXELS),
            ]
        )
        west, east, north, south = on_ellipsoid(self.degrees(around))
        across, down = np.linalg.norm(east - west), np.linalg.norm(south - north)
        return float(across / (2 * BASELINE_PIXELS)), float(down / (2 * BASELINE_PIXELS))

    @property
    def name(self) -> str:
        """The coordinate system in a word or two: its EPSG code, or what its definition calls it."""
        code = self.crs.to_epsg()
        said: str = f"EPSG:{code}" if code else self.crs.to_wkt().split('"')[1]
        return said


def on_ellipsoid(degrees_N2: Array) -> Array:
    """(lat, lon) in degrees, WGS84 -> (N, 3) metres from the Earth's centre. There neither poles
    nor date line are seams.
    """
    lat, lon = np.radians(degrees_N2).T
    radius = EQUATOR_M**2 / np.hypot(EQUATOR_M * np.cos(lat), POLE_M * np.sin(lat))
    flat = radius * np.cos(lat)
    return np.stack(
        [flat * np.cos(lon), flat * np.sin(lon), radius * (POLE_M / EQUATOR_M) ** 2 * np.sin(lat)],
        axis=1,
    )


def parse_crs(name: str) -> CRS | None:
    """The coordinate system of a name such as EPSG:32633; None where there is none of it."""
    with rasterio.Env():  # outside of one, GDAL prints its errors
        try:
            return CRS.from_user_input(name)
        except CRSError:
            return None


def _to_wgs84(crs: CRS, xs: Array, ys: Array) -> tuple[Array, Array]:
    """Longitudes and latitudes, NaN where there are none."""
    try:
        lon, lat = (
            np.array(values, float) for values in transform(crs, WGS84, xs.tolist(), ys.tolist())
        )
    except CPLE_BaseError:  # one place outside of the projection fails them all
        if len(xs) == 1:
            return np.array([np.nan]), np.array([np.nan])
        half = len(xs) // 2
        parts = [_to_wgs84(crs, xs[cut], ys[cut]) for cut in (slice(half), slice(half, None))]
        lon, lat = (np.concatenate(values) for values in zip(*parts, strict=True))
    outside = ~(np.isfinite(lon) & np.isfinite(lat))
    return np.where(outside, np.nan, lon), np.where(outside, np.nan, lat)
