"""The interface of every source: a layout of imagery on some storage, read as records.

In: a folder or file. Out: an ImageRecord per image, a Rejection per image that cannot be used, and
a SkippedFile for every other file. A source judges names and tables; packing judges pixels.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from pipeline.core import storage
from pipeline.core.progress import console
from pipeline.core.records import ImageRecord, Rejection, Scanned, SkippedFile
from pipeline.images.decode import DecodeError
from pipeline.images.inspect import undecoded_format
from pipeline.images.optional_formats import convert_optional, extra_for

MAX_REASONS = 6
"Reasons that the summary of a scan names, the most common first."


@dataclass(frozen=True, kw_only=True)
class Source(ABC):
    """A layout. Its fields are its settings: flags of the command line, and part of the manifest's
    record of how a set was packed.
    """

    @abstractmethod
    def scan(self, root: str) -> Iterator[Scanned]:
        """All images at `root`, in an order that depends on their names alone.

        Raises InputError when `root` does not have this layout.
        """

    def read(self, record: ImageRecord) -> bytes:
        """The encoded image: the file's own bytes, unless it is of a format that an extra converts
        or a source cuts its images out of larger ones.

        Raises OSError, or DecodeError with a reason that fits better.
        """
        data = convert_optional(record.path, storage.read_bytes(record.path))
        if isinstance(data, Rejection):
            raise DecodeError(data.reason, data.found)
        return data

    def ending(self, record: ImageRecord) -> str:
        """The suffix of the image in a shard, behind the key's dot: jpg, png, tif, webp."""
        if extra_for(record.path):
            return "png"
        ending = record.path.rsplit(".", 1)[-1].lower()
        return {"jpeg": "jpg", "tiff": "tif"}.get(ending, ending)


def scan_images(source: Source, root: str) -> Iterator[ImageRecord | Rejection]:
    """The images that a source finds. At the end the terminal shows how many there were, how many
    of them with a position and with tags that could not be read, and what was passed over and
    refused, by reason.
    """
    images = positions = unreadable = 0
    example = ""
    refused: Counter[str] = Counter()
    skipped: Counter[str] = Counter()
    for found in source.scan(root):
        if isinstance(found, SkippedFile):
            skipped[found.reason] += found.count
            continue
        if isinstance(found, Rejection):
            refused[found.reason] += 1
        else:
            images += 1
            positions += found.geotag is not None
            if found.unreadable_tags:
                unreadable += 1
                example = example or f"{found.name}: {found.unreadable_tags}"
        yield found
    line = f"{root}: {images:,} images found, {positions:,} with a position"
    if unreadable:
        line += f"; {unreadable:,} with tags that could not be read (such as {example})"
    for name, counts in (("passed over", skipped), ("refused", refused)):
        if counts:
            line += f"; {counts.total():,} {name} ({by_reason(counts)})"
    console.print(line, markup=False)


def by_reason(counts: Counter[str]) -> str:
    """`companion file .kml: 4, another zoom: 2`, the most common first."""
    named = [f"{reason}: {count:,}" for reason, count in counts.most_common(MAX_REASONS)]
    others = counts.total() - sum(count for _, count in counts.most_common(MAX_REASONS))
    return ", ".join(named + ([f"others: {others:,}"] if others else []))


def not_an_image(path: str) -> Rejection | SkippedFile:
    """A file among images whose name is not one of an image that is read: refused where it is an
    image of another format, else passed over as a companion of images.
    """
    if rejection := undecoded_format(path):
        return rejection
    name = path.rsplit("/", 1)[-1]
    ending = f".{name.rpartition('.')[2].lower()}" if "." in name[1:] else ""
    # A long or odd ending is a name with a dot in it, and no kind of file.
    plain = len(ending) <= 6 and ending[1:].isalnum()
    kind = f"companion file {ending}" if plain else "file that is no image by its name"
    return SkippedFile(path=path, reason=kind)
