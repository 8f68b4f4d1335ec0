"""GTA-UAV as its authors lay it out on disk -> ImageRecords.

`drone/images/*.png`, `satellite/<zoom>_….png`, and JSON lists of pairs, `{cross,same}-area-drone2sate-{train,test}.json`:
for each drone image the satellite tiles that show its ground, with the overlap (IoU) of the two footprints as weight.

A tile's location is its own name. A drone image's location is the tile of the greatest weight: one
image has one label here, where the authors' evaluation lets any positive tile count. Images of the
train list are for training, together with the tiles that are locations of theirs; images of the
test list are queries, and the gallery is all tiles. An image on neither list belongs to the other
division, and is left out. Positions are the game's, which is no place on the earth, so there are no
geotags.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import MAX_EXCERPT_LENGTH, ImageRecord, Rejection, Split, View
from pipeline.images.inspect import is_image_name
from pipeline.sources.base import Source, not_an_image
from pipeline.sources.folders import require_images, wrong_folder
from pipeline.sources.text_tables import Unreadable, parse_number

LAYOUT = "GTA-UAV's root, which holds drone/images/, satellite/ and <area>-area-drone2sate-{train,test}.json"
DRONE, SATELLITE = "drone/images", "satellite"
LIST_SUFFIXES = {Split.TRAIN: "train", Split.QUERY: "test"}


@dataclass(frozen=True, kw_only=True)
class GtaUav(Source):
    """GTA-UAV, official layout."""

    division: Literal["cross-area", "same-area"] = "cross-area"
    "Which of the authors' two divisions into train and test: of different areas, or of the same."
    pairs: Literal["pos", "pos_semipos"] = "pos"
    """Which tiles may be a drone image's location: those that overlap enough (pos), or also those
    that do so in part. An image that has none is left out, as in the authors' evaluation."""

    def scan(self, root: str) -> Iterator[ImageRecord | Rejection]:
        return require_images(self._scan(root), root, LAYOUT)

    def _scan(self, root: str) -> Iterator[ImageRecord | Rejection]:
        files = storage.walk(root)
        lists = {
            split: f"{self.division}-drone2sate-{phase}.json"
            for split, phase in LIST_SUFFIXES.items()
        }
        if not any(name in files for name in lists.values()):
            there = (
                ", ".join(path for path in files if path.endswith(".json") and "/" not in path)
                or "no JSON"
            )
            raise InputError(
                f"{root} holds {there}, expected {' or '.join(lists.values())}; check --root and --division"
            )
        yield from _misplaced_files(root, files)
        for split, name in lists.items():
            if name not in files:
                continue
            used = set()
            for item in self._pairs(storage.join(root, name)):
                if isinstance(item, Rejection):
                    yield item
                    continue
                drone, tile = item
                missing = [path for path in (drone, tile) if path not in files]
                if missing:
                    found = f"{name} names {' and '.join(missing)}"
                    yield Rejection(
                        path=storage.join(root, drone), reason="file is missing", found=found
                    )
                    continue
                used.add(tile)
                yield _record(root, drone, files, split, View.DRONE, tile)
            if split == Split.TRAIN:
                yield from (
                    _record(root, tile, files, split, View.SATELLITE, tile) for tile in sorted(used)
                )
            else:
                tiles = (
                    path
                    for path in files
                    if path.rpartition("/")[0] == SATELLITE and is_image_name(path)
                )
                yield from (
                    _record(root, tile, files, Split.GALLERY, View.SATELLITE, tile)
                    for tile in tiles
                )

    def _pairs(self, path: str) -> Iterator[tuple[str, str] | Rejection]:
        """Paths of a drone image and of its best tile, below the root, in the order of their names.

        Raises InputError when the file is no JSON list.
        """
        try:
            entries = storage.read_json(path)
        except (ValueError, RecursionError) as error:
            raise InputError(
                f"{path} cannot be read as JSON ({error}); download it again"
            ) from None
        if not isinstance(entries, list):
            raise InputError(
                f"{path} holds a {type(entries).__name__}, expected a list of pairs; download it again"
            )
        found = []
        for place, entry in enumerate(entries):
            try:
                drone, tile = best_pair(entry, self.pairs)
            except Unreadable as error:
                yield Rejection(
                    path=path, reason="unreadable pair", found=f"entry {place}: {error}"
                )
                continue
            if tile is not None:
                found.append((drone, tile))
        yield from sorted(found)


def best_pair(entry: Any, pairs: str) -> tuple[str, str | None]:
    """Paths below the root of a drone image and of its tile of greatest weight, the first of
    equals; None where it has no tile.

    Raises Unreadable.
    """
    try:
        folder, name = entry.get("drone_img_dir", DRONE), entry["drone_img_name"]
        tiles, weights = (
            entry[f"pair_{pairs}_sate_img_list"],
            entry[f"pair_{pairs}_sate_weight_list"],
        )
        if not (isinstance(folder, str) and isinstance(name, str) and len(tiles) == len(weights)):
            raise Unreadable(f"{name!r} has {len(tiles)} tiles and {len(weights)} weights")
        if not (isinstance(tiles, list) and all(isinstance(tile, str) for tile in tiles)):
            raise Unreadable(f"{name!r} has tiles that are no names")
        weighed = [parse_number(str(weight)) for weight in weights]
    except Unreadable:
        raise
    except (AttributeError, KeyError, TypeError) as error:
        raise Unreadable(
            f"{str(entry)[:MAX_EXCERPT_LENGTH]}: {type(error).__name__} {error}"
        ) from None
    drone = f"{folder.strip('/')}/{name}"
    return drone, f"{SATELLITE}/{tiles[weighed.index(max(weighed))]}" if tiles else None


def _misplaced_files(root: str, files: Iterable[str]) -> Iterator[Rejection]:
    """What lies among the images and is none, or lies deeper than they do."""
    for path in files:
        top = next((top for top in (DRONE, SATELLITE) if path.startswith(f"{top}/")), None)
        if top and path.rpartition("/")[0] != top:
            yield wrong_folder(storage.join(root, path), f"{path} is not {top}/<image>")
        elif top and not is_image_name(path):
            yield not_an_image(storage.join(root, path))


def _record(
    root: str, path: str, files: dict[str, int], split: Split, view: View, tile: str
) -> ImageRecord:
    location = tile.rpartition("/")[2].rpartition(".")[0]
    return ImageRecord(
        path=storage.join(root, path), split=split, view=view, location=location, bytes=files[path]
    )
