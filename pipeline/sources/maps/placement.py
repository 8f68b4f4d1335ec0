"""Where a mosaic lies, and whether its position may be trusted.

In: a GeoTIFF. Out: its Georeference and which way it must be turned, or why it cannot be placed:
it has no coordinates, its files contradict each other, or the shift of its datum is unknown.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import rasterio
from pyproj import CRS

from pipeline.core import storage
from pipeline.sources.maps.georeference import Georeference, locate_roughly, parse_crs
from pipeline.sources.maps.mosaic import open_mosaic, transform_by

MIN_PIXEL_M = 1e-6
"Smaller pixels all lie on one point, or on one line."
ACCURATE_M = 1.0
"The terminal line names the accuracy of a datum shift that is less accurate than this."
SOURCES = {"INTERNAL": "the file", "WORLDFILE": "its world file", "PAM": "its .aux.xml"}
"Statements of a transform, by GDAL's name: in the file, and in files beside it."
SIDECARS = (".tfw", ".tifw", ".tiffw", ".wld", ".TFW", ".TIFW", ".WLD")
MAX_DISAGREEMENT = 1.5
"Pixels by which statements may differ: two conventions for a pixel's origin differ by half."


class MosaicRejected(Exception):
    """A mosaic that cannot be cut into tiles; `reason` and `found` as in a Rejection."""

    def __init__(self, reason: str, found: str) -> None:
        super().__init__(f"{reason}: {found}")
        self.reason, self.found = reason, found


@dataclass(frozen=True, kw_only=True)
class Placement:
    """The position of a mosaic."""

    georeference: Georeference
    flip: tuple[bool, bool]
    "Whether tiles are mirrored left-right and upside down, so that they show the ground as it is."
    pixel_m: tuple[float, float]
    "Width and height of a pixel on the ground at the mosaic's centre, metres."
    description: str
    "Coordinate system, datum shift and turning, for a person."


def place_mosaic(path: str, crs_name: str | None, assume_wgs84: bool) -> Placement:
    """Where a mosaic lies. `crs_name`: its coordinate system where it names none. `assume_wgs84`:
    whether a datum with an unknown shift is taken for WGS84.

    Raises MosaicRejected, rasterio.errors.RasterioIOError.
    """
    dataset = open_mosaic(path)
    crs = _crs_of(dataset, crs_name)
    affine = _one_transform(path, dataset)
    centre = (dataset.width / 2, dataset.height / 2)
    georeference = Georeference(
        crs=crs,
        affine=affine,
        assume_wgs84=assume_wgs84,
        around=locate_roughly(crs, affine, centre),
    )
    datum = _check_datum(georeference, centre)
    pixel_m = georeference.ground_pixel(centre)
    name = georeference.name
    if not np.isfinite(pixel_m).all():
        raise MosaicRejected("no coordinates", f"its centre lies nowhere on Earth by {name}")
    if not min(pixel_m) > MIN_PIXEL_M:
        found = f"pixels of {pixel_m[0]:g} x {pixel_m[1]:g} m by {name}, expected larger ones"
        raise MosaicRejected("no coordinates", found)
    flip = georeference.flip(centre)
    turned = {
        (False, False): "",
        (True, False): ", east-left: mirrored left-right when read",
        (False, True): ", south-up: mirrored upside down when read",
        (True, True): ", upside down: turned by 180 degrees when read",
    }[flip]
    return Placement(
        georeference=georeference, flip=flip, pixel_m=pixel_m, description=f"{name}{datum}{turned}"
    )


def _crs_of(dataset: Any, crs_name: str | None) -> CRS:
    points = len(dataset.gcps[0])
    if dataset.transform.is_identity:
        stated = f"{points} ground control points alone" if points else "no transform"
        found = f"{stated}; expected pixels with coordinates: warp it with gdalwarp"
        raise MosaicRejected("no coordinates", found)
    if dataset.crs:
        # WKT 2 keeps the codes by which PROJ finds a datum's shift; the older WKT loses some.
        crs = parse_crs(dataset.crs.to_wkt(version="WKT2_2019"))
    else:
        crs = parse_crs(crs_name) if crs_name else None
    if crs is None:
        found = "no coordinate system; expected one: name it with --crs EPSG:..."
        raise MosaicRejected("no coordinates", found)
    return crs


def _one_transform(path: str, dataset: Any) -> rasterio.Affine:
    """The transform of a mosaic. Raises MosaicRejected where the file and those beside it state
    different ones.
    """
    used: rasterio.Affine = dataset.transform
    stem = path.rpartition(".")[0]
    beside = (f"{path}.aux.xml", *(stem + ending for ending in SIDECARS))
    if not storage.is_local(path) or not any(map(storage.exists, beside)):
        return used
    corners = [(0, 0), (dataset.width, 0), (dataset.width, dataset.height), (0, dataset.height)]
    for source, name in SOURCES.items():
        affine = transform_by(path, source)
        if affine is None:
            continue
        # Back to pixels of the one that is used: a disagreement in pixels means the same anywhere.
        away = [~used @ (affine @ corner) for corner in corners]
        gap = max(np.hypot(x - at[0], y - at[1]) for (x, y), at in zip(away, corners, strict=True))
        if gap > MAX_DISAGREEMENT:
            raise MosaicRejected(
                "contradicting coordinates",
                f"{name} places a corner {gap:.6g} pixels from where GDAL does by all of "
                f"{', '.join(SOURCES.values())}; correct one, or take it away",
            )
    return used


def _check_datum(georeference: Georeference, centre: tuple[float, float]) -> str:
    """What the terminal line says of the datum's shift to WGS84. Raises MosaicRejected."""
    shift = georeference.shift(centre)
    if shift == "known":
        accuracy = georeference.accuracy_m(centre)
        if accuracy is None or accuracy <= ACCURATE_M:
            return ""
        return f" (shift to WGS84 good to {accuracy:g} m)"
    if shift == "nowhere":
        return ""
    datum = georeference.datum
    if georeference.resembles_wgs84:
        return f" (datum {datum} taken for WGS84: same ellipsoid)"
    if georeference.assume_wgs84:
        return (
            f" (WARNING: no shift from datum {datum} to WGS84 is known here, and none is made: "
            "positions may be wrong by hundreds of metres)"
        )
    raise MosaicRejected(
        "unknown datum shift",
        f"PROJ knows no shift from datum {datum} ({georeference.name}) to WGS84 at its centre, so "
        "positions would be wrong by up to a kilometre; reproject it to WGS84 with the parameters "
        "of your survey (gdalwarp with +towgs84 or a grid), or accept that with --assume-wgs84",
    )
