"""Imagery as found -> ImageRecords; one file per layout."""

from pipeline.sources.geotiff import GeoTiff
from pipeline.sources.source import Source
from pipeline.sources.university1652 import University1652
from pipeline.sources.xyz import Xyz

SOURCES: dict[str, type[Source]] = {"university1652": University1652, "geotiff": GeoTiff, "xyz": Xyz}
"By the name that `--source` takes."


def name_of(source: Source) -> str:
    """The name that `--source` takes for a source."""
    return next(name for name, kind in SOURCES.items() if type(source) is kind)
