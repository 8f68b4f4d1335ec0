"""Imagery as found on disk -> ImageRecords; one file per layout."""

from collections.abc import Callable, Iterator

from pipeline.records import ImageRecord, Rejection
from pipeline.sources import university1652

SOURCES: dict[str, Callable[[str], Iterator[ImageRecord | Rejection]]] = {"university1652": university1652.scan}
"By the name that `--source` takes: root folder -> its images, and what cannot be one."
