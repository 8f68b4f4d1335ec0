"""GTA-UAV as its authors distribute it -> ImageRecords.

`drone/images/*.png`, `satellite/<zoom>_….png`, and JSON lists of pairs,
`{cross,same}-area-drone2sate-{train,test}.json`: for each drone image the satellite tiles that show
its ground, with the overlap (IoU) of the two footprints as weight.

A tile's location is its own name. A drone image's location is the tile of the greatest weight: one
image has one label here, where the authors' evaluation accepts any positive tile. Images of the
train list are for training, together with the tiles that are their locations; images of the test
list are queries, and the gallery is all tiles. An image on neither list belongs to the other
division, and is passed over. Positions are those of the game, which is not on Earth, so there are
no geotags.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import (
    MAX_EXCERPT_LENGTH,
    ImageRecord,
    Rejection,
    Scanned,
    SkippedFile,
    Split,
    View,
)
from pipeline.images.inspect import is_image_name
from pipeline.sources.base import Source, not_an_image
from pipeline.sources.folders import require_images, wrong_folder
from pipeline.sources.text_tables import Unreadable, parse_number

_LAYOUT = (
    "GTA-UAV's root, which holds drone/images/, satellite/ and "
    "<area>-area-drone2sate-{train,test}.json"
)
DRONE, SATELLITE = "drone/images", "satellite"
LIST_SUFFIXES = {Split.TRAIN: "train", Split.QUERY: "test"}


@dataclass(frozen=True, kw_only=True)
class GtaUav(Source):
    """GTA-UAV, official layout."""

    division: Literal["cross-area", "same-area"] = "cross-area"
    "Which of the authors' two divisions into train and test: of different areas, or of the same."
    pairs: Literal["pos", "pos_semipos"] = "pos"
    """Which tiles may be a drone image's location: those that overlap enough (pos), or also those
    that overlap in part. An image without such a tile is passed over, as in the authors'
    evaluation."""

    def scan(self, root: str) -> Iterator[Scanned]:
        return require_images(self._scan(root), root, _LAYOUT)

    def _scan(self, root: str) -> Iterator[Scanned]:
        files = storage.walk(root)
        lists = {
            split: f"{self.division}-drone2sate-{phase}.json"
            for split, phase in LIST_SUFFIXES.items()
        }
        if not any(name in files for name in lists.values()):
            found = [path for path in files if path.endswith(".json") and "/" not in path]
            raise InputError(
                f"{root} holds {', '.join(found) or 'no JSON'}, expected "
                f"{' or '.join(lists.values())}; check --root and --division"
            )
        listed: set[str] = set()
        for split, name in lists.items():
            if name in files:
                yield from self._listed(root, name, files, split, listed)
        yield from _other_files(root, files, listed, self.division)

    def _listed(
        self, root: str, name: str, files: dict[str, int], split: Split, listed: set[str]
    ) -> Iterator[Scanned]:
        """The images of one list and the tiles that belong to it; adds the drone images that it
        names to `listed`.
        """
        used = set()
        for item in self._pairs(storage.join(root, name), listed):
            if not isinstance(item, tuple):
                yield item
                continue
            drone, tile = item
            missing = [path for path in (drone, tile) if path not in files]
            if missing:
                found, path = f"{name} names {' and '.join(missing)}", storage.join(root, drone)
                yield Rejection(path=path, reason="file is missing", found=found)
                continue
            used.add(tile)
            yield _record(root, drone, files, split, View.DRONE, tile)
        if split == Split.TRAIN:
            tiles = sorted(used)
        else:
            split = Split.GALLERY
            tiles = [
                path
                for path in files
                if path.rpartition("/")[0] == SATELLITE and is_image_name(path)
            ]
        yield from (_record(root, tile, files, split, View.SATELLITE, tile) for tile in tiles)

    def _pairs(
        self, path: str, listed: set[str]
    ) -> Iterator[tuple[str, str] | Rejection | SkippedFile]:
        """Paths of a drone image and of its best tile, below the root, in the order of their names.

        Raises InputError when the file is not a JSON list.
        """
        try:
            entries = storage.read_json(path)
        except (ValueError, RecursionError) as error:
            raise InputError(
                f"{path} cannot be read as JSON ({error}); download it again"
            ) from None
        if not isinstance(entries, list):
            raise InputError(
                f"{path} holds a {type(entries).__name__}, expected a list of pairs; "
                "download it again"
            )
        best: dict[str, str] = {}
        contradicted = set()
        for number, entry in enumerate(entries):
            try:
                drone, tile = best_pair(entry, self.pairs)
                listed.add(drone)
                if tile is not None and best.setdefault(drone, tile) != tile:
                    contradicted.add(drone)
                    raise Unreadable(f"{drone} lies in {tile} here and in {best[drone]} before")
            except Unreadable as error:
                found = f"entry {number}: {error}"
                yield Rejection(path=path, reason="unreadable pair", found=found)
                continue
            if tile is None:
                yield SkippedFile(path=drone, reason="image without a tile that overlaps enough")
        yield from sorted(pair for pair in best.items() if pair[0] not in contradicted)


def best_pair(entry: Any, pairs: str) -> tuple[str, str | None]:
    """Paths below the root of a drone image and of its tile of greatest weight, the first of equal
    ones; None where it has no tile.

    Raises Unreadable.
    """
    try:
        folder, name = entry.get("drone_img_dir", DRONE), entry["drone_img_name"]
        tiles = entry[f"pair_{pairs}_sate_img_list"]
        weights = entry[f"pair_{pairs}_sate_weight_list"]
        if not (isinstance(folder, str) and isinstance(name, str) and len(tiles) == len(weights)):
            raise Unreadable(f"{name!r} has {len(tiles)} tiles and {len(weights)} weights")
        if not (isinstance(tiles, list) and all(isinstance(tile, str) for tile in tiles)):
            raise Unreadable(f"{name!r} has tiles that are no names")
        numbers = [parse_number(str(weight)) for weight in weights]
    except Unreadable:
        raise
    except (AttributeError, KeyError, TypeError) as error:
        cause = f"{type(error).__name__} {error}"
        raise Unreadable(f"{str(entry)[:MAX_EXCERPT_LENGTH]}: {cause}") from None
    drone = f"{folder.strip('/')}/{name}"
    return drone, f"{SATELLITE}/{tiles[numbers.index(max(numbers))]}" if tiles else None


def _other_files(
    root: str, files: dict[str, int], listed: set[str], division: str
) -> Iterator[Rejection | SkippedFile]:
    """Files in the folders of images that are no images, lie deeper, or are on no list."""
    for path in files:
        top = next((top for top in (DRONE, SATELLITE) if path.startswith(f"{top}/")), None)
        if top is None:
            continue
        full_path = storage.join(root, path)
        if not is_image_name(path):
            yield not_an_image(full_path)
        elif path.rpartition("/")[0] != top:
            yield wrong_folder(full_path, f"{path} is not {top}/<image>")
        elif top == DRONE and path not in listed:
            yield SkippedFile(path=full_path, reason=f"image on no list of {division}")


def _record(
    root: str, path: str, files: dict[str, int], split: Split, view: View, tile: str
) -> ImageRecord:
    location = tile.rpartition("/")[2].rpartition(".")[0]
    return ImageRecord(
        path=storage.join(root, path), split=split, view=view, location=location, bytes=files[path]
    )
