"""Imagery of any layout, read as records: one file per layout, one line in SOURCES.

In: a root on some storage - a public data set, a folder of photos, GeoTIFF mosaics, web map tiles,
a table. Out: for each image an ImageRecord with split, view, location and, where known, its
geotag; a Rejection with a reason for each image that cannot be used; a SkippedFile for each other
file, so that the counts at the end of a scan add up. `Source.read` returns an image's bytes, which
for a map are cut, turned and encoded at that moment.

Begin with `base.py`, then the smallest layout, `university1652.py`. `maps/` holds what several
layouts need of maps: tiles, coordinate systems, mosaics, MBTiles, GeoJSON shapes.
"""

from importlib import import_module
from typing import cast

from pipeline.sources.base import Source

SOURCES: dict[str, str] = {
    "university1652": "pipeline.sources.university1652:University1652",
    "sues200": "pipeline.sources.sues200:Sues200",
    "denseuav": "pipeline.sources.denseuav:DenseUAV",
    "gta-uav": "pipeline.sources.gta_uav:GtaUav",
    "visloc": "pipeline.sources.visloc:VisLoc",
    "photos": "pipeline.sources.photos:Photos",
    "geotiff": "pipeline.sources.geotiff:GeoTiff",
    "xyz": "pipeline.sources.xyz:Xyz",
    "table": "pipeline.sources.table:Table",
}
"""Module and class by the name that `--source` takes; a new source is one file and one line. A
module is imported when it is named: some of them import rasterio, PROJ or Arrow."""


def source_class(name: str) -> type[Source]:
    """The class of a name in SOURCES."""
    module, _, kind = SOURCES[name].partition(":")
    return cast(type[Source], getattr(import_module(module), kind))


def name_of(source: Source) -> str:
    """The name that `--source` takes for a source; of one that is not listed, its class's name."""
    kind = type(source)
    path = f"{kind.__module__}:{kind.__qualname__}"
    return next((name for name, listed in SOURCES.items() if listed == path), kind.__name__)
