"""Imagery as found -> ImageRecords; one file per layout."""

from pipeline.sources.photos import Photos
from pipeline.sources.source import Source
from pipeline.sources.table import Table
from pipeline.sources.university1652 import University1652

SOURCES: dict[str, type[Source]] = {"university1652": University1652, "photos": Photos, "table": Table}
"By the name that `--source` takes."


def name_of(source: Source) -> str:
    """The name that `--source` takes for a source."""
    return next(name for name, kind in SOURCES.items() if type(source) is kind)
