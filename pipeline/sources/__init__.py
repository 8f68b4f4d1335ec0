"""Imagery as found -> ImageRecords; one file per layout."""

from pipeline.sources.base import Source
from pipeline.sources.denseuav import DenseUAV
from pipeline.sources.geotiff import GeoTiff
from pipeline.sources.gta_uav import GtaUav
from pipeline.sources.photos import Photos
from pipeline.sources.sues200 import Sues200
from pipeline.sources.table import Table
from pipeline.sources.university1652 import University1652
from pipeline.sources.visloc import VisLoc
from pipeline.sources.xyz import Xyz

SOURCES: dict[str, type[Source]] = {
    "university1652": University1652,
    "sues200": Sues200,
    "denseuav": DenseUAV,
    "gta-uav": GtaUav,
    "visloc": VisLoc,
    "photos": Photos,
    "geotiff": GeoTiff,
    "xyz": Xyz,
    "table": Table,
}
"By the name that `--source` takes."


def name_of(source: Source) -> str:
    """The name that `--source` takes for a source; of one that is not listed, its class's name."""
    return next(
        (name for name, kind in SOURCES.items() if type(source) is kind), type(source).__name__
    )
