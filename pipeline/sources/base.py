"""What every source is: a layout of imagery on some storage, told as records, and how their bytes
are read.

In: a folder or file. Out: ImageRecords, and a Rejection for each thing that cannot be one. Nothing
is judged by its pixels here; packing does that.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

from pipeline.core import storage
from pipeline.core.records import ImageRecord, Rejection


@dataclass(frozen=True, kw_only=True)
class Source(ABC):
    """A layout. Its fields are its settings: flags of the command line, and part of what the
    manifest says of a set.
    """

    @abstractmethod
    def scan(self, root: str) -> Iterator[ImageRecord | Rejection]:
        """All images at `root`, in an order that depends on their names alone.

        Raises InputError when `root` is no such layout.
        """

    def read(self, record: ImageRecord) -> bytes:
        """The encoded image: the file's own bytes, unless a source cuts its images out of larger
        ones.

        Raises OSError, or DecodeError with a reason that fits better.
        """
        return storage.read_bytes(record.path)

    def ending(self, record: ImageRecord) -> str:
        """What stands behind the key's dot in a shard: jpg, png, tif, webp."""
        ending = record.path.rsplit(".", 1)[-1].lower()
        return {"jpeg": "jpg", "tiff": "tif"}.get(ending, ending)


def not_an_image(path: str) -> Rejection:
    """A file among the images whose name says that it is none."""
    return Rejection(path=path, reason="not an image's name", found=path.rsplit("/", 1)[-1])
