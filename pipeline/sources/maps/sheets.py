"""A map in several files: GeoTIFFs of one grid -> a VRT, GDAL's description of them as one.

In: a folder. Out: a small XML file that `mosaic.py` opens as it opens a GeoTIFF, so that windows
and tiles lie across the sheets' seams. Headers are read here, and no pixels.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np
import rasterio
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.errors import RasterioError

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.sources.maps.mosaic import MOSAIC_SUFFIXES, open_mosaic, root_cause

MAX_DRIFT_PIXELS = 0.1
"Over the longer side of a sheet, by which its resolution may differ from that of the first."
Box = tuple[int, int, int, int]
"Left, upper, right and lower edge, pixels."


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """What a GeoTIFF's header says."""

    path: str
    size: tuple[int, int]
    "Width and height, pixels."
    affine: rasterio.Affine
    crs: Any
    dtype: str
    colours: tuple[ColorInterp, ...]
    names: tuple[str, ...]
    "Of the bands; empty where they have none."
    nodata: float | None
    masked: bool
    "Whether it has alpha or a mask."
    block: tuple[int, int]


def as_one_map(mosaic: str, vrt: str) -> str:
    """The path of a map: itself where it is a file, else `vrt`, a file that is written so that it
    shows a folder's GeoTIFFs as one map.

    Raises InputError where there are none, or they are no sheets of one map.
    """
    return join_sheets(find_sheets(mosaic), vrt) if storage.is_folder(mosaic) else mosaic


def find_sheets(folder: str) -> list[str]:
    """Paths of a folder's GeoTIFFs, at any depth, in the order of their names.

    Raises InputError where there are none, or the folder is not of this machine.
    """
    if not storage.is_local(folder):
        raise InputError(
            f"{folder} is no folder of this machine, expected the sheets of a map in a local or "
            "mounted one; copy them"
        )
    names = [name for name in storage.walk(folder) if name.lower().endswith(MOSAIC_SUFFIXES)]
    if not names:
        raise InputError(f"no .tif or .tiff below {folder}, expected the sheets of a map")
    return [storage.join(folder, name) for name in names]


def join_sheets(paths: Sequence[str], vrt: str) -> str:
    """Write `vrt`, which shows GeoTIFFs of this machine as one map, where it does not yet; its
    path. Raises InputError where they are no sheets of one map."""
    here = [storage.absolute(storage.resolve(path)[1]) for path in paths]
    document = describe_sheets([read_sheet(path) for path in here])
    if not storage.exists(vrt) or storage.read_bytes(vrt) != document:
        storage.write_bytes(vrt, document)
    return vrt


def read_sheet(path: str) -> Sheet:
    """Raises InputError where it is no GeoTIFF, or one that cannot be a sheet."""
    try:
        dataset = open_mosaic(path)
    except RasterioError as error:
        raise InputError(
            f"{path} is no GeoTIFF ({root_cause(error)}), expected one; repair it or take it away"
        ) from None
    structure = dataset.tags(ns="IMAGE_STRUCTURE") | dataset.tags(1, ns="IMAGE_STRUCTURE")
    plain = "MINISWHITE" not in structure and "NBITS" not in structure
    if ColorInterp.palette in dataset.colorinterp or not plain:
        raise InputError(
            f"{path} has a palette, white as zero or fewer bits than its type, expected a sheet in "
            "plain grey or RGB; convert it with gdal_translate -expand rgb"
        )
    if dataset.crs is None or dataset.transform.is_identity:
        raise InputError(
            f"{path} has no coordinate system or transform, expected a georeferenced GeoTIFF; "
            "repair it or take it away"
        )
    return Sheet(
        path=path, size=(dataset.width, dataset.height), affine=dataset.transform,
        crs=dataset.crs, dtype=dataset.dtypes[0], colours=dataset.colorinterp,
        names=tuple(name or "" for name in dataset.descriptions), nodata=dataset.nodata,
        masked=any(MaskFlags.per_dataset in flags for flags in dataset.mask_flag_enums),
        block=dataset.block_shapes[0],
    )  # fmt: skip


def describe_sheets(sheets: Sequence[Sheet]) -> bytes:
    """The VRT of sheets of one map; of those that overlap, later ones lie above.

    A sheet off the first one's grid is moved onto it, by half a pixel at most. Raises InputError
    where they differ in coordinate system, resolution, bands or nodata.
    """
    first = sheets[0]
    for sheet in sheets[1:]:
        _check_alike(first, sheet)
    origins = [_origin(first, sheet) for sheet in sheets]
    left, top = (min(origin[axis] for origin in origins) for axis in (0, 1))
    boxes = [
        (x - left, y - top, x - left + sheet.size[0], y - top + sheet.size[1])
        for (x, y), sheet in zip(origins, sheets, strict=True)
    ]
    width, height = max(box[2] for box in boxes), max(box[3] for box in boxes)
    root = ElementTree.Element("VRTDataset", rasterXSize=str(width), rasterYSize=str(height))
    _add(root, "SRS", first.crs.to_wkt())
    affine = first.affine @ rasterio.Affine.translation(left, top)
    _add(root, "GeoTransform", ", ".join(repr(value) for value in affine.to_gdal()))
    masked = any(sheet.masked for sheet in sheets)
    for number, colour in enumerate(first.colours, 1):
        band = _add(root, "VRTRasterBand", dataType=_type_name(first.dtype), band=str(number))
        _add(band, "Description", first.names[number - 1])
        _add(band, "ColorInterp", colour.name.capitalize())
        if first.nodata is not None:
            _add(band, "NoDataValue", repr(first.nodata))
        _add_sources(band, sheets, boxes, str(number), masked)
    has_alpha, has_nodata = ColorInterp.alpha in first.colours, first.nodata is not None
    if not (has_alpha or has_nodata) and (masked or has_gaps(boxes)):
        mask = _add(_add(root, "MaskBand"), "VRTRasterBand", dataType="Byte")
        _add_sources(mask, sheets, boxes, "mask,1", masked)
    ElementTree.indent(root)
    return ElementTree.tostring(root) + b"\n"


def has_gaps(boxes: Iterable[Box]) -> bool:
    """Whether the rectangle around boxes has a place that none of them covers."""
    edges = np.array(list(boxes))
    xs, ys = np.unique(edges[:, [0, 2]]), np.unique(edges[:, [1, 3]])
    covered = np.zeros((len(ys) - 1, len(xs) - 1), np.bool_)
    for left, top, right, bottom in edges:
        rows, columns = np.searchsorted(ys, (top, bottom)), np.searchsorted(xs, (left, right))
        covered[slice(*rows), slice(*columns)] = True
    return not covered.all()


def _check_alike(first: Sheet, sheet: Sheet) -> None:
    """Raises InputError where two sheets are not of one grid."""
    drift = max(
        abs(one - other) * max(sheet.size) / math.hypot(first.affine.a, first.affine.d)
        for one, other in zip(_steps(first), _steps(sheet), strict=True)
    )
    kinds = [(one.dtype, *(colour.name for colour in one.colours)) for one in (first, sheet)]
    nodata = [repr(one.nodata) for one in (first, sheet)]  # NaN is NaN
    for what, alike, values in (
        ("coordinate system", first.crs == sheet.crs, [first.crs, sheet.crs]),
        ("resolution", drift <= MAX_DRIFT_PIXELS, [_resolution(first), _resolution(sheet)]),
        ("bands", kinds[0] == kinds[1], [" ".join(kind) for kind in kinds]),
        ("nodata value", nodata[0] == nodata[1], nodata),
    ):
        if not alike:
            raise InputError(
                f"{sheet.path} differs from {first.path} in its {what} ({values[1]} instead of "
                f"{values[0]}), expected the sheets of one map; convert it with gdalwarp"
            )


def _steps(sheet: Sheet) -> tuple[float, ...]:
    """The four terms of a transform that are no position."""
    a, b, _, d, e, _ = sheet.affine[:6]
    return a, b, d, e


def _resolution(sheet: Sheet) -> str:
    return " ".join(f"{step:.8g}" for step in _steps(sheet))


def _origin(first: Sheet, sheet: Sheet) -> tuple[int, int]:
    """Column and row, in the first sheet's pixels, of a sheet's upper left corner."""
    x, y = ~first.affine @ (sheet.affine.c, sheet.affine.f)
    return round(x), round(y)


def _add_sources(
    band: ElementTree.Element, sheets: Sequence[Sheet], boxes: Sequence[Box], of: str, masked: bool
) -> None:
    """A band's sources: band `of` of each sheet. Where sheets have nodata or masks, one shows what
    lies below it through its gaps."""
    nodata = sheets[0].nodata
    plain = nodata is None and not masked
    for sheet, (left, top, right, bottom) in zip(sheets, boxes, strict=True):
        source = _add(band, "SimpleSource" if plain else "ComplexSource")
        _add(source, "SourceFilename", sheet.path, relativeToVRT="0")
        _add(source, "SourceBand", of)
        size = [str(side) for side in (right - left, bottom - top)]
        area = dict(zip(("xSize", "ySize"), size, strict=True))
        # With them GDAL opens a sheet only when it is read.
        _add(source, "SourceProperties", RasterXSize=size[0], RasterYSize=size[1],
             DataType=_type_name(sheet.dtype), BlockXSize=str(sheet.block[1]),
             BlockYSize=str(sheet.block[0]))  # fmt: skip
        _add(source, "SrcRect", xOff="0", yOff="0", **area)
        _add(source, "DstRect", xOff=str(left), yOff=str(top), **area)
        if masked:
            _add(source, "UseMaskBand", "true")
        elif nodata is not None:
            _add(source, "NODATA", repr(nodata))


def _type_name(dtype: str) -> str:
    """GDAL's name of a NumPy type, whatever the case of its letters."""
    return "Byte" if dtype == "uint8" else dtype


def _add(
    parent: ElementTree.Element, name: str, text: str = "", **attributes: str
) -> ElementTree.Element:
    element = ElementTree.SubElement(parent, name, attributes)
    element.text = text or None
    return element
