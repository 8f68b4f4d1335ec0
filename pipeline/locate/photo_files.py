"""Photos that someone names -> files to read, in order, and when they were taken.

In: paths or URIs of photos and folders. Out: names of photos; times from the camera's tags or from
a table.
"""

import csv
import io
import math
from collections.abc import Sequence
from datetime import UTC, datetime

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.images.camera_tags import read_tags
from pipeline.images.image_blocks import UnreadableTag, find_metadata
from pipeline.images.inspect import is_image_name


def find_photos(named: Sequence[str]) -> list[str]:
    """The photos named, and those below the folders named, each once, in that order; within a
    folder by path.

    Raises InputError where something named is not there, or a folder holds no image.
    """
    photos: dict[str, None] = {}
    for path in named:
        if storage.is_folder(path):
            found = [storage.join(path, name) for name in storage.walk(path) if is_image_name(name)]
            if not found:
                raise InputError(
                    f"no images below {path}; expected a folder of photos; name another"
                )
            photos |= dict.fromkeys(found)
        elif storage.exists(path):
            photos[path] = None
        else:
            raise InputError(f"no photo or folder at {path}; expected one; check the name")
    if not photos:
        raise InputError(
            "no photo was named, expected one or more photos or folders; name some at the end of the command"
        )
    return list(photos)


def parent_folder(photo: str) -> str:
    """The folder that a photo lies in."""
    return photo.rpartition("/")[0] or "."


def read_taken_at(data: bytes) -> str | None:
    """When the camera says that it took a photo, ISO 8601; None where it does not say."""
    try:
        return read_tags(find_metadata(data, complete=True)).taken_at
    except UnreadableTag:
        return None


def parse_time(said: str) -> float:
    """Seconds since 1970 of an ISO 8601 time, or of a plain number of seconds. Without an offset it
    is taken for UTC: within a flight only differences count.

    Raises ValueError.
    """
    try:
        value = float(said)
    except ValueError:
        time = datetime.fromisoformat(said)
        return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
    if not math.isfinite(value):
        raise ValueError(said)
    return value


def read_times(path: str, photos: Sequence[str]) -> dict[str, str]:
    """Times by photo out of a CSV table with the columns `photo` (a path, or its last part) and
    `time`.

    Raises InputError where it is no such table, or says nothing of one of the photos.
    """
    if not storage.is_file(path):
        raise InputError(
            f"no table at {path}; expected a CSV file with the columns photo and time; check --times"
        )
    try:
        rows = list(
            csv.DictReader(io.StringIO(storage.read_bytes(path).decode("utf-8-sig", "replace")))
        )
    except csv.Error as error:
        raise InputError(
            f"{path} cannot be read as CSV ({error}); expected the columns photo and time; mend it"
        ) from None
    if not rows or not {"photo", "time"} <= rows[0].keys():
        raise InputError(
            f"{path} has no rows with the columns photo and time; expected both; write its first line so"
        )
    said = {row["photo"]: row["time"] or "" for row in rows}
    times = {}
    for photo in photos:
        time = said.get(photo, said.get(photo.rpartition("/")[2]))
        if time is None:
            raise InputError(
                f"{path} says nothing of {photo}; expected a time for each photo; add a row for it"
            )
        try:
            parse_time(time)
        except ValueError:
            raise InputError(
                f"{path} says {time!r} of {photo}; expected seconds or an ISO 8601 time such as 2026-11-24T09:30:00"
            ) from None
        times[photo] = time
    return times
