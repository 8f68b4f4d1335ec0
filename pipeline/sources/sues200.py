"""SUES-200, prepared for training and testing or as downloaded -> ImageRecords.

Prepared: `Training/<height>/{drone,satellite}/<location>/` and
`Testing/<height>/{query,gallery}_{drone,satellite}/<location>/`; each height has the same satellite
images, which are read once. As downloaded: `drone_view_512/<location>/<height>/` and
`satellite-view/<location>/`, divided here as the benchmark does it: the locations of its list are
for training, all others are queries, and the gallery is all 200. There are no positions, so no
geotags; the height is the variant.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from pipeline.core import storage
from pipeline.core.errors import require
from pipeline.core.records import ImageRecord, Rejection, Scanned, SkippedFile, Split, View
from pipeline.images.inspect import is_image_name
from pipeline.sources.base import Source, not_an_image
from pipeline.sources.folders import (
    LocatedImage,
    images_by_location,
    require_images,
    split_folders,
    wrong_folder,
)

_LAYOUT = (
    "SUES-200's root, which holds {Training,Testing}/<height>/, or "
    "drone_view_512/<location>/<height>/ and satellite-view/<location>/"
)
HEIGHTS = (150, 200, 250, 300)
TRAIN_NUMBERS = (
    1, 2, 3, 4, 5, 6, 7, 9, 10, 11, 13, 15, 16, 20, 21, 24, 25, 26, 27, 28, 29, 30, 31, 32, 33,
    34, 36, 37, 39, 43, 44, 45, 51, 55, 56, 57, 58, 60, 64, 66, 67, 69, 70, 73, 74, 76, 77, 80,
    81, 82, 84, 85, 86, 87, 88, 89, 90, 91, 94, 96, 97, 100, 101, 102, 103, 104, 105, 106, 113,
    116, 118, 119, 120, 123, 125, 126, 127, 129, 132, 134, 137, 139, 141, 142, 145, 146, 147,
    148, 149, 151, 152, 155, 156, 157, 158, 159, 160, 163, 166, 167, 168, 169, 171, 174, 179,
    180, 182, 183, 184, 185, 186, 187, 191, 192, 193, 196, 197, 198, 199, 200,
)  # fmt: skip
"""The benchmark's 120, from script/indexs.yaml of github.com/Reza-Zhu/SUES-200-Benchmark; the other
80 are for testing."""
TRAIN_LOCATIONS = frozenset(f"{number:04d}" for number in TRAIN_NUMBERS)


@dataclass(frozen=True, kw_only=True)
class Sues200(Source):
    """SUES-200, prepared for training and testing or as downloaded."""

    heights: tuple[int, ...] = HEIGHTS
    """Heights of flight whose drone images are packed, metres. The paper's figures are for one
    height at a time."""

    def __post_init__(self) -> None:
        valid = bool(self.heights) and set(self.heights) <= set(HEIGHTS)
        require(valid, "heights", self.heights, f"one or more of {' '.join(map(str, HEIGHTS))}")

    def scan(self, root: str) -> Iterator[Scanned]:
        return require_images(self._scan(root), root, _LAYOUT)

    def _scan(self, root: str) -> Iterator[Scanned]:
        phases = (storage.join(root, phase) for phase in ("Training", "Testing"))
        if any(map(storage.is_folder, phases)):
            yield from self._prepared(root)
        else:
            yield from self._downloaded(root)

    def _prepared(self, root: str) -> Iterator[Scanned]:
        seen = set()
        for part in split_folders((View.DRONE, View.SATELLITE), "Training", "Testing"):
            for height in sorted(self.heights):
                folder = storage.join(root, part.phase, str(height), part.folder)
                for item in images_by_location(folder):
                    if not isinstance(item, LocatedImage):
                        yield item
                    elif part.view == View.DRONE:
                        yield _record(item, part.split, View.DRONE, height)
                    elif (name := (part.split, item.location, item.name)) not in seen:
                        seen.add(name)
                        yield _record(item, part.split, View.SATELLITE)

    def _downloaded(self, root: str) -> Iterator[Scanned]:
        for drone in self._drone_images(storage.join(root, "drone_view_512")):
            if not isinstance(drone, tuple):
                yield drone
                continue
            image, height = drone
            for split in _splits_of(image.location):
                yield _record(image, split, View.DRONE, height)
        for item in images_by_location(storage.join(root, "satellite-view")):
            if not isinstance(item, LocatedImage):
                yield item
                continue
            for split in _splits_of(item.location):
                yield _record(item, split, View.SATELLITE)

    def _drone_images(
        self, folder: str
    ) -> Iterator[tuple[LocatedImage, int] | Rejection | SkippedFile]:
        """Images at `<folder>/<location>/<height>/<image>`, with their height."""
        if not storage.is_folder(folder):
            return
        for path, size in storage.walk(folder).items():
            full_path, parts = storage.join(folder, path), path.split("/")
            if not is_image_name(path):
                yield not_an_image(full_path)
            elif len(parts) != 3 or parts[1] not in map(str, HEIGHTS):
                yield wrong_folder(full_path, f"{path} is not <location>/<height>/<image>")
            elif int(parts[1]) not in self.heights:
                yield SkippedFile(path=full_path, reason=f"height {parts[1]}, not in --heights")
            else:
                image = LocatedImage(path=full_path, name=parts[2], location=parts[0], bytes=size)
                yield image, int(parts[1])


def _splits_of(location: str) -> tuple[Split, ...]:
    return (Split.TRAIN if location in TRAIN_LOCATIONS else Split.QUERY), Split.GALLERY


def _record(
    image: LocatedImage, split: Split, view: View, height: int | None = None
) -> ImageRecord:
    return ImageRecord(
        path=image.path,
        split=split,
        view=view,
        location=image.location,
        variant="" if height is None else str(height),
        bytes=image.bytes,
    )
