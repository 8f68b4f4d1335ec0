"""Imagery as found -> ImageRecords; one file per layout."""

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
"""Module and class by the name that `--source` takes; a new source is one file and one line. Imported
when it is named: some of them import rasterio, PROJ or Arrow."""


def source_class(name: str) -> type[Source]:
    """The class of a name in SOURCES."""
    module, _, kind = SOURCES[name].partition(":")
    return cast(type[Source], getattr(import_module(module), kind))


def name_of(source: Source) -> str:
    """The name that `--source` takes for a source; of one that is not listed, its class's name."""
    kind = type(source)
    path = f"{kind.__module__}:{kind.__qualname__}"
    return next((name for name, listed in SOURCES.items() if listed == path), kind.__name__)
