"""What belongs to an index: its encoder and its tiles, named in a file beside it.

In: the settings of a job that searches an index. Out: the same with the encoder and the shards of
the index, where flags name none. `jobs/adapt.py` writes the file.
"""

from dataclasses import replace
from typing import Protocol, TypeVar

from model.weights.builtin import BUILTIN
from pipeline.core import json_files, storage
from pipeline.core.errors import InputError

LOCALIZER_FILE = "localizer.json"
"In the index's folder: paths of `checkpoint` and `shards` from there."


class SearchSettings(Protocol):
    """Settings of a job that searches an index."""

    @property
    def index(self) -> str: ...
    @property
    def checkpoint(self) -> str: ...
    @property
    def shards(self) -> str | None: ...


S = TypeVar("S", bound=SearchSettings)


def write_localizer(index: str, checkpoint: str, shards: str) -> None:
    """Note encoder and shards, paths relative to the index, beside it."""
    paths = {"checkpoint": checkpoint, "shards": shards}
    json_files.write_checksummed(storage.join(index, LOCALIZER_FILE), paths)


def with_localizer(settings: S) -> S:
    """The settings with the index's own encoder and shards, where they name neither.

    Raises InputError where the file beside the index is damaged.
    """
    path = storage.join(settings.index, LOCALIZER_FILE)
    if not storage.exists(path):
        return settings
    try:
        found = json_files.read_checksummed(path)
        checkpoint, shards = (str(found[name]) for name in ("checkpoint", "shards"))
    except (ValueError, KeyError) as error:
        raise InputError(
            f"{path} is damaged ({error}), expected what jobs/adapt.py writes; remove it and give "
            "--checkpoint and --shards"
        ) from None
    given = {"checkpoint": settings.checkpoint, "shards": settings.shards}
    if settings.checkpoint == BUILTIN:
        given["checkpoint"] = storage.join(settings.index, checkpoint)
    if settings.shards is None:
        given["shards"] = storage.join(settings.index, shards)
    return replace(settings, **given)  # type: ignore[type-var]
