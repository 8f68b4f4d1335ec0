"""The photos and folders named on a command line -> files to read, in order, and their times.

In: paths or URIs of photos and folders. Out: paths of photos; times from the cameras' tags or from
a table.
"""

import csv
import io
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.progress import console
from pipeline.images.camera_tags import CameraTags, read_tags
from pipeline.images.image_blocks import UnreadableTag, find_metadata
from pipeline.images.inspect import RAW_SUFFIXES, is_image_name, is_undecoded_image_name


def find_photos(paths: Sequence[str]) -> list[str]:
    """The photos named, and those below the folders named, each once, in that order; within a
    folder by path. Photos in formats that may not be decodable (HEIC, DNG) are among them, so that
    each gets an answer or a reason.

    Other files below the folders, and raw copies of photos, are counted on the console. Raises
    InputError where a path does not exist, or a folder contains no image.
    """
    photos: dict[str, None] = {}
    skipped: Counter[str] = Counter()
    for path in paths:
        if storage.is_folder(path):
            names = list(_images(storage.walk(path), skipped))
            if not names:
                raise InputError(
                    f"no images below {path}; expected a folder of photos; name another"
                )
            photos |= dict.fromkeys(storage.join(path, name) for name in names)
        elif storage.exists(path):
            photos[path] = None
        else:
            raise InputError(f"no photo or folder at {path}; expected one; check the name")
    if not photos:
        raise InputError(
            "no photo was named, expected one or more photos or folders; name some at the end of "
            "the command"
        )
    if skipped:
        reasons = ", ".join(f"{reason}: {count:,}" for reason, count in skipped.most_common())
        console.print(f"{skipped.total():,} files passed over ({reasons})", markup=False)
    return list(photos)


def _images(names: Iterable[str], skipped: Counter[str]) -> Iterator[str]:
    """The names of images; the others are counted by reason in `skipped`."""
    names = list(names)
    stems = {_stem(name) for name in names if is_image_name(name)}
    for name in names:
        if name.lower().endswith(RAW_SUFFIXES) and _stem(name) in stems:
            skipped["raw copy of a photo"] += 1
        elif is_image_name(name) or is_undecoded_image_name(name):
            yield name
        else:
            skipped["not an image by its name"] += 1


def _stem(name: str) -> str:
    return name.rpartition(".")[0].lower()


def parent_folder(photo: str) -> str:
    """The folder of a photo; "." where its path names none."""
    return photo.rpartition("/")[0] or "."


def read_photo_tags(data: bytes) -> CameraTags:
    """The camera's tags; none of them where they contradict each other."""
    try:
        return read_tags(find_metadata(data, complete=True))
    except UnreadableTag:
        return CameraTags()


def parse_time(text: str) -> float:
    """Seconds since 1970 of an ISO 8601 time, or of a plain number of seconds.

    A time without an offset is taken as UTC: within a flight only differences count. Raises
    ValueError.
    """
    try:
        value = float(text)
    except ValueError:
        time = datetime.fromisoformat(text)
        return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def read_times(path: str, photos: Sequence[str]) -> dict[str, str]:
    """Times by photo from a CSV table with the columns `photo` (a path, or its last part) and
    `time`.

    Raises InputError where it is not such a table, or has no valid time for one of the photos.
    """
    by_name = {row["photo"]: row["time"] for row in read_rows(path, ("photo", "time"), "--times")}
    times = {}
    for photo in photos:
        time = by_name.get(photo, by_name.get(photo.rpartition("/")[2]))
        if time is None:
            raise InputError(
                f"{path} has no row for {photo}; expected a time for each photo; add a row for it"
            )
        try:
            parse_time(time)
        except ValueError:
            raise InputError(
                f"{path} has the time {time!r} for {photo}; expected seconds or an ISO 8601 time "
                "such as 2026-11-24T09:30:00"
            ) from None
        times[photo] = time
    return times


def read_rows(path: str, columns: Sequence[str], flag: str) -> list[dict[str, str]]:
    """The rows of a table of photos by column; `flag` has named it.

    Raises InputError where there is none, or it is not CSV with these columns.
    """
    if not storage.is_file(path):
        raise InputError(
            f"no table at {path}; expected a CSV file with the columns {', '.join(columns)}; check "
            f"{flag}"
        )
    return parse_rows(storage.read_bytes(path).decode("utf-8-sig", "replace"), columns, path)


def parse_rows(text: str, columns: Sequence[str], path: str) -> list[dict[str, str]]:
    """The rows of a table's text; missing cells are empty. Raises InputError."""
    try:
        rows = list(csv.DictReader(io.StringIO(text), restval=""))
    except csv.Error as error:
        raise InputError(
            f"{path} cannot be read as CSV ({error}); expected the columns {', '.join(columns)}; "
            "repair the file"
        ) from None
    if not rows or not set(columns) <= rows[0].keys():
        raise InputError(
            f"{path} has no rows with the columns {', '.join(columns)}; expected all of them; "
            "write its first line so"
        )
    return rows
