"""An index on disk that may be replaced while it is searched: the new one is taken over when it is
whole, else refused.

In: the path of an index. Out: the opened index with its calibration, in use until another has
proved itself. Who searches holds a reference, so nothing is taken from under a search.
"""

import threading
import time
from dataclasses import dataclass

import numpy as np

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.index.metadata import METADATA_FILE
from pipeline.index.searcher import Index
from pipeline.locate import calibration as confidence
from pipeline.locate.calibration import Calibration, find_calibration
from pipeline.locate.gallery_map import read_gallery_map

POLL_INTERVAL_S = 2.0
"Between two looks at what is at the path."
RETRY_S = 10.0
"""After which a refused index is tried again though its index.json is the same: whoever copies a
folder file by file may copy that one first."""


FileContents = tuple[bytes | None, ...]
"""What the files hold by which an index is known, index.json and calibration.json; None for one
that is not there."""


@dataclass(frozen=True, kw_only=True)
class OpenedIndex:
    """What answers."""

    index: Index
    confidence: Calibration | None
    "None where the index was not calibrated."
    spacing_m: float | None
    "Without a calibration, how far apart candidates may lie that agree: the gallery's own spacing."


def open_verified(path: str) -> OpenedIndex:
    """Raises InputError when there is no index at `path`, or a calibration that is another's."""
    index = Index(path, whole=True)  # a damaged list is met by few searches, and late
    calibration = find_calibration(path, index.facts)
    spacing_m = None if calibration else read_gallery_map(index).spacing_m
    return OpenedIndex(index=index, confidence=calibration, spacing_m=spacing_m)


class LiveIndex:
    """`current` is the index in use; `refused` says why the newest one at the path is not it, or is
    None.
    """

    def __init__(self, path: str) -> None:
        """Raises InputError when there is no index at `path` that can be used."""
        self._path = path
        self._taken = self._seen = (
            self._said()
        )  # before it is opened: a change meanwhile is found by the next look
        self.current = open_verified(path)
        self.refused: str | None = None
        self._refused_at = 0.0

    def _said(self) -> FileContents:
        return tuple(
            _read(storage.join(self._path, name))
            for name in (METADATA_FILE, confidence.CALIBRATION_FILE)
        )

    def look(self) -> None:
        """Take over what is new at the path. Whatever is wrong with it, the old index stays;
        nothing is raised.
        """
        said = self._said()
        if said == self._seen and (
            self.refused is None or time.monotonic() < self._refused_at + RETRY_S
        ):
            return
        if said == self._taken:  # it is back as it was
            self._seen, self.refused = said, None
            return
        try:
            fresh = open_verified(self._path)
            validate_index(fresh.index, self.current.index)
        except (
            Exception
        ) as error:  # FAISS, Arrow, JSON and file systems each raise their own over broken files
            self._refuse(said, error)
            return
        if self._said() != said:  # written once more meanwhile: what was opened may be half of each
            return
        self.current, self.refused = fresh, None
        self._taken = self._seen = said

    def _refuse(self, said: FileContents, error: Exception) -> None:
        why = str(error).strip().split("\n")[0] or type(error).__name__
        self._seen, self._refused_at = said, time.monotonic()
        self.refused = f"the new index is refused and the old one goes on answering: {why}"

    def follow(self, stop: threading.Event) -> None:
        """Look every LOOK_EVERY_S seconds until `stop` is set: for a thread of its own."""
        while not stop.wait(POLL_INTERVAL_S):
            self.look()


def _read(path: str) -> bytes | None:
    try:
        return storage.read_bytes(path)
    except OSError:
        return None


def validate_index(fresh: Index, old: Index) -> None:
    """Raises InputError where an index cannot stand in for the old one, and whatever a trial search
    raises.
    """
    made_by, expected = fresh.told.fingerprint, old.told.fingerprint
    if made_by != expected:
        raise InputError(
            f"it was made by network {made_by[:12]}, the service's is {expected[:12]}, expected the same; start the service "
            "again with the other network"
        )
    trial_1D = np.full((1, fresh.dimension), fresh.dimension**-0.5, np.float32)
    if not fresh.search(trial_1D, 1)[0]:
        raise InputError("a trial search found nothing, expected a row; build the index again")
