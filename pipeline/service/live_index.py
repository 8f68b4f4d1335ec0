"""An index on disk that may be replaced while it is searched: a new one is used once it is complete
and valid, else refused.

In: the path of an index. Out: the opened index with its calibration, in use until another one has
passed validation. A search keeps a reference to its index, so a replacement never closes an index
in use.
"""

import threading
import time
from dataclasses import dataclass

import numpy as np

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.index.metadata import METADATA_FILE
from pipeline.index.searcher import Index
from pipeline.locate.calibration import CALIBRATION_FILE, Calibration, find_calibration
from pipeline.locate.gallery_map import read_gallery_map
from pipeline.service.photo_map import MapOpener, PhotoMap, no_map

POLL_INTERVAL_S = 2.0
"Seconds between two checks of the files at the path."

RETRY_S = 10.0
"""Seconds after which a refused index is tried again although its index.json is unchanged: a copy
of a folder, file by file, may begin with that one."""

FileContents = tuple[bytes | None, ...]
"Contents of index.json and calibration.json, which identify an index; None for a missing file."


@dataclass(frozen=True, kw_only=True)
class OpenedIndex:
    """An index in use."""

    index: Index
    calibration: Calibration | None
    "None where the index was not calibrated."
    spacing_m: float | None
    "The gallery's spacing, which sets the agreement radius without a calibration; else None."
    finest_side_m: float | None
    "Side of the tiles of the gallery's finest level, to which the spacing belongs."
    photo_map: PhotoMap | None
    "The gallery's pixels; None where they are not at hand."


def open_verified(path: str, open_map: MapOpener = no_map) -> OpenedIndex:
    """Open an index and verify every byte of it; open its gallery's pixels.

    Raises InputError when there is no index at `path`, or a calibration of another encoder, and
    what `open_map` raises.
    """
    index = Index(path, verify=True)  # few searches would meet a damaged inverted list, and late
    calibration = find_calibration(path, index.metadata.fingerprint)
    gallery = read_gallery_map(index)
    return OpenedIndex(
        index=index,
        calibration=calibration,
        spacing_m=None if calibration else gallery.spacing_m,
        finest_side_m=gallery.finest_side_m,
        photo_map=open_map(gallery),
    )


class LiveIndex:
    """`current` is the index in use; `refused` is why the newest one at the path is not, or
    None."""

    def __init__(self, path: str, open_map: MapOpener = no_map) -> None:
        """`open_map` opens the pixels of each index's gallery. Raises InputError when there is no
        index at `path` that can be used."""
        self._path, self._open_map = path, open_map
        # Read before the index is opened: the next poll finds a change made meanwhile.
        self._current_files = self._seen_files = self._read_files()
        self.current = open_verified(path, open_map)
        self.refused: str | None = None
        self._refused_at = 0.0

    def _read_files(self) -> FileContents:
        names = (METADATA_FILE, CALIBRATION_FILE)
        return tuple(_read(storage.join(self._path, name)) for name in names)

    def poll(self) -> None:
        """Switch to a new index at the path. If it is not valid the old one stays; nothing is
        raised."""
        files = self._read_files()
        retry = self.refused is not None and time.monotonic() >= self._refused_at + RETRY_S
        if files == self._seen_files and not retry:
            return
        if files == self._current_files:  # changed back
            self._seen_files, self.refused = files, None
            return
        try:
            opened = open_verified(self._path, self._open_map)
            validate_index(opened.index, self.current.index)
        except Exception as error:  # FAISS, Arrow, JSON and file systems each raise their own
            self._refuse(files, error)
            return
        if self._read_files() != files:  # written again meanwhile: a mixture may have been opened
            return
        self.current, self.refused = opened, None
        self._current_files = self._seen_files = files

    def _refuse(self, files: FileContents, error: Exception) -> None:
        reason = str(error).strip().split("\n")[0] or type(error).__name__
        self._seen_files, self._refused_at = files, time.monotonic()
        self.refused = f"the new index is refused, the old one stays in use: {reason}"

    def watch(self, stop: threading.Event) -> None:
        """Poll every POLL_INTERVAL_S seconds until `stop` is set; for a thread of its own."""
        while not stop.wait(POLL_INTERVAL_S):
            self.poll()


def _read(path: str) -> bytes | None:
    try:
        return storage.read_bytes(path)
    except OSError:
        return None


def validate_index(new: Index, old: Index) -> None:
    """Raise InputError where an index cannot replace the old one, and whatever a trial search
    raises."""
    found, expected = new.metadata.fingerprint, old.metadata.fingerprint
    if found != expected:
        raise InputError(
            f"it was made by encoder {found[:12]}, the service's is {expected[:12]}, expected the "
            "same; start the service again with the other encoder"
        )
    trial_1D = np.full((1, new.dimension), new.dimension**-0.5, np.float32)
    if not new.search(trial_1D, 1)[0]:
        raise InputError("a trial search found nothing, expected a row; build the index again")
