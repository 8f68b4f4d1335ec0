"""Where the pixels of a mosaic lie on the Earth: an affine transform and a coordinate system.

In: pixel positions, (x, y) from the upper left corner of the upper left pixel. Out: latitudes and
longitudes, WGS84, and the ground size of a pixel. PROJ does the geodesy; this module decides which
of its answers may be used. PROJ has a "ballpark" answer for a datum whose shift to WGS84 it does
not know: a shift of zero, which is 850 m wrong for TWD67 in Taiwan. It is used only where the
datum's ellipsoid is that of WGS84, as such datums (CGCS2000 and other modern ones) differ from
WGS84 by a few metres at most, or where the user asks for it.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
import pyproj
import rasterio
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import AreaOfInterest

from pipeline.core.arrays import Doubles
from pipeline.core.records import GeoTag
from pipeline.sources.maps.tiles import Window

WGS84 = CRS.from_epsg(4326)
ELLIPSOID = pyproj.Geod(ellps="WGS84")
Shift = Literal["known", "unknown", "nowhere"]
BASELINE_PIXELS = 10.0
"""Pixels on either side of the position that is measured: enough against rounding, little against
the map's distortion."""
MAX_COORDINATE = 1e12
"In any unit: no position on Earth has larger coordinates, and PROJ takes long to find that out."
ALIKE_M, ALIKE_FLATTENING = 1.0, 1e-4
"""Within these of WGS84's half axis (metres) and inverse flattening lie the ellipsoids of GRS 1980
and CGCS2000, and no ellipsoid of a national datum of the last century."""


@dataclass(frozen=True, kw_only=True)
class Georeference:
    """Maps pixels of one mosaic to positions."""

    crs: CRS
    "Of the coordinates that `affine` gives."
    affine: rasterio.Affine
    "Pixel positions to coordinates; rotated and sheared transforms are fine."
    assume_wgs84: bool = False
    "Whether a datum without a known shift is taken for WGS84."
    around: tuple[float, float] | None = None
    """Rough latitude and longitude of the mosaic. Shifts of datums are valid for regions; PROJ uses
    one of another region where it knows no better, unless it is told the region."""

    def degrees(self, pixels_N2: Doubles) -> Doubles:
        """(lat, lon) of pixel positions, (N, 2): latitude within +-90, longitude within +-180.

        NaN where a position lies outside of what the projection can show, where its coordinate
        system has no position on Earth, and where the shift of its datum is unknown.
        """
        x, y = pixels_N2.T
        a, b, c, d, e, f = self.affine[:6]
        xs, ys = a * x + b * y + c, d * x + e * y + f
        near = (np.abs(xs) < MAX_COORDINATE) & (np.abs(ys) < MAX_COORDINATE)  # False for NaN
        xs, ys = np.where(near, xs, np.nan), np.where(near, ys, np.nan)
        lon, lat = _to_wgs84(_transformer(self.crs, False, self.around), xs, ys)
        if self.assume_wgs84 or self.resembles_wgs84:
            lost = np.isnan(lon)
            lon[lost], lat[lost] = _to_wgs84(
                _transformer(self.crs, True, self.around), xs[lost], ys[lost]
            )
        # A mosaic may run on beyond the date line.
        lon = np.where(np.abs(lon) > 180, (lon + 180) % 360 - 180, lon)
        return np.stack([np.clip(lat, -90, 90), lon], axis=1)

    def geotags(
        self, windows: Iterable[Window], flip: tuple[bool, bool] = (False, False)
    ) -> list[GeoTag | None]:
        """For each window its centre and its four corners; None where the centre has no position.

        `flip`: whether the image is mirrored left-right and upside down when it is read, so that
        its upper left corner is another one of the window's.
        """
        pixels = [
            (window.centre, *(window.corners[at] for at in corner_order(flip)))
            for window in windows
        ]
        degrees_NK2 = self.degrees(np.array(pixels, float).reshape(-1, 2)).reshape(-1, 5, 2)
        tags: list[GeoTag | None] = []
        for centre, *corners in degrees_NK2.tolist():
            if np.isnan(centre).any():
                tags.append(None)
                continue
            known = not np.isnan(corners).any()
            footprint = tuple((lat, lon) for lat, lon in corners) if known else None
            tags.append(GeoTag(lat=centre[0], lon=centre[1], footprint=footprint))
        return tags

    def ground_pixel(self, pixel: tuple[float, float]) -> tuple[float, float]:
        """Width and height in metres, on the ground, of the pixel at a position; NaN where
        `degrees` is.

        Measured along geodesics between positions a few pixels apart: true metres, whatever the
        map's unit and scale are.
        """
        (across, _), (down, _) = self._directions(pixel)
        return across / (2 * BASELINE_PIXELS), down / (2 * BASELINE_PIXELS)

    def flip(self, pixel: tuple[float, float]) -> tuple[bool, bool]:
        """Whether an image must be mirrored left-right, and upside down, to show the ground as it
        is with north more up than down, judged at a position.

        A south-up raster (its rows run north) and an east-left one are mirror images of the
        ground. One that is rotated by more than 90 degrees is turned by 180.
        """
        (_, along_row), (_, along_column) = self._directions(pixel)
        x_east, x_north = np.sin(along_row), np.cos(along_row)
        y_east, y_north = np.sin(along_column), np.cos(along_column)
        mirrored = x_east * y_north - x_north * y_east > 0
        # How far east the columns run and how far south the rows do, for each choice of mirrors.
        if mirrored:
            return (True, False) if -x_east - y_north > x_east + y_north else (False, True)
        upside_down = bool(x_east - y_north < -0.5)  # not for a rotation by about 90 degrees
        return upside_down, upside_down

    def _directions(self, pixel: tuple[float, float]) -> tuple[tuple[float, float], ...]:
        """Along a row and down a column, over two baselines: metres, and radians from north."""
        (x, y), reach = pixel, BASELINE_PIXELS
        around = np.array([(x - reach, y), (x + reach, y), (x, y - reach), (x, y + reach)])
        lat, lon = self.degrees(around).T
        azimuths, _, metres = ELLIPSOID.inv(lon[0::2], lat[0::2], lon[1::2], lat[1::2])
        return tuple(zip(metres.tolist(), np.radians(azimuths).tolist(), strict=True))

    @property
    def name(self) -> str:
        """The coordinate system in a word or two: its EPSG code, else its definition's name."""
        code = self.crs.to_epsg()
        return f"EPSG:{code}" if code else self.crs.name

    @property
    def datum(self) -> str:
        """The name of its datum."""
        return self.crs.datum.name if self.crs.datum else "unknown"

    @property
    def resembles_wgs84(self) -> bool:
        """Whether its datum's ellipsoid is that of WGS84, of GRS 1980 (0.1 mm smaller at the poles)
        or of CGCS2000.
        """
        ours, theirs = WGS84.ellipsoid, self.crs.ellipsoid
        return (
            ours is not None
            and theirs is not None
            and abs(theirs.semi_major_metre - ours.semi_major_metre) < ALIKE_M
            and abs(theirs.inverse_flattening - ours.inverse_flattening) < ALIKE_FLATTENING
        )

    def shift(self, pixel: tuple[float, float]) -> Shift:
        """Whether PROJ knows the shift from the datum to WGS84 at a position; nowhere: the
        position is not on Earth by any datum.
        """
        x, y = (np.array([value]) for value in self.affine @ pixel)
        answers: tuple[tuple[bool, Shift], ...] = ((False, "known"), (True, "unknown"))
        for ballpark, answer in answers:
            if np.isfinite(_to_wgs84(_transformer(self.crs, ballpark, self.around), x, y)[0]).all():
                return answer
        return "nowhere"

    def accuracy_m(self, pixel: tuple[float, float]) -> float | None:
        """How accurate the shift to WGS84 is at a position, metres, by the EPSG data set; None
        where that does not say.
        """
        area = _area(self.around)
        transformer = Transformer.from_crs(self.crs, WGS84, always_xy=True, area_of_interest=area)
        transformer.transform(*(self.affine @ pixel))
        try:  # of several operations the one that was right here; of one its own
            accuracy = transformer.get_last_used_operation().accuracy
        except ProjError:
            accuracy = transformer.accuracy
        return None if accuracy < 0 else float(accuracy)


def corner_order(flip: tuple[bool, bool]) -> tuple[int, ...]:
    """Which of a window's corners (clockwise from its upper left) are those of the mirrored image,
    clockwise from its upper left.
    """
    order = (0, 1, 2, 3)
    if flip[0]:
        order = (order[1], order[0], order[3], order[2])
    if flip[1]:
        order = (order[3], order[2], order[1], order[0])
    return order


def parse_crs(name: str) -> CRS | None:
    """The coordinate system of a name such as EPSG:32633, or of WKT; None where there is none."""
    try:
        return CRS.from_user_input(name)
    except CRSError:
        return None


def locate_roughly(
    crs: CRS, affine: rasterio.Affine, pixel: tuple[float, float]
) -> tuple[float, float] | None:
    """Latitude and longitude of a pixel to a hundredth of a degree, by any shift of the datum; None
    where it is not on Earth.
    """
    loose = Georeference(crs=crs, affine=affine, assume_wgs84=True)
    lat, lon = loose.degrees(np.array([pixel], float))[0].tolist()
    return (round(lat, 2), round(lon, 2)) if np.isfinite(lat) else None


@lru_cache(maxsize=64)
def _transformer(
    crs: CRS, ballpark: bool, around: tuple[float, float] | None
) -> Transformer | None:
    """From `crs` to WGS84, longitude first, by operations that are valid `around` a position; None
    where PROJ knows none. Making one takes up to half a second; threads may share it.
    """
    try:
        return Transformer.from_crs(
            crs, WGS84, always_xy=True, allow_ballpark=ballpark, area_of_interest=_area(around)
        )
    except ProjError:
        return None


def _area(around: tuple[float, float] | None) -> AreaOfInterest | None:
    return None if around is None else AreaOfInterest(around[1], around[0], around[1], around[0])


def _to_wgs84(transformer: Transformer | None, xs: Doubles, ys: Doubles) -> tuple[Doubles, Doubles]:
    """Longitudes and latitudes, NaN where there are none."""
    if transformer is None:
        return np.full(len(xs), np.nan), np.full(len(xs), np.nan)
    lon, lat = (np.array(values, float) for values in transformer.transform(xs, ys))
    lost = ~(np.isfinite(lon) & np.isfinite(lat))
    lon[lost] = lat[lost] = np.nan
    return lon, lat
