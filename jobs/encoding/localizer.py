"""What belongs to an index: its encoder, its tiles and the heights of its ground, named in a file
beside it.

In: the settings of a job that searches an index. Out: the same with the encoder, the shards and the
surface model of the index, where flags name none. `jobs/adapt.py` writes the file.
"""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Protocol, TypeVar

from model.weights.builtin import BUILTIN
from pipeline.core import json_files, storage
from pipeline.core.errors import InputError
from pipeline.core.progress import console

LOCALIZER_FILE = "localizer.json"
"In the index's folder: paths of `checkpoint` and `shards` from there, and of `surface`, if any."


class SearchSettings(Protocol):
    """Settings of a job that searches an index."""

    @property
    def index(self) -> str: ...
    @property
    def checkpoint(self) -> str: ...
    @property
    def shards(self) -> str | None: ...
    @property
    def surface(self) -> str | None: ...


S = TypeVar("S", bound=SearchSettings)


@dataclass(frozen=True, kw_only=True)
class Localizer:
    """What belongs to an index: paths. In the file, those of what lies in the folder around the
    index are relative to it, so that this folder can be moved."""

    checkpoint: str
    shards: str
    surface: str | None = None


def write_localizer(index: str, localizer: Localizer) -> None:
    """Note beside an index what belongs to it."""
    region = Path(index).parent
    relative = {
        name: f"../{Path(path).relative_to(region)}"
        for name, path in asdict(localizer).items()
        if path and Path(path).is_relative_to(region)
    }
    json_files.write_checksummed(storage.join(index, LOCALIZER_FILE), asdict(localizer) | relative)


def read_localizer(index: str) -> Localizer | None:
    """What is noted beside an index, with its paths as this process names them; None where nothing
    is.

    Raises InputError where the file is damaged.
    """
    path = storage.join(index, LOCALIZER_FILE)
    if not storage.exists(path):
        return None
    try:
        found = json_files.read_checksummed(path)
        surface = found.get("surface")
        return Localizer(
            checkpoint=_path_from(index, found["checkpoint"]),
            shards=_path_from(index, found["shards"]),
            surface=surface and _path_from(index, surface),
        )
    except (ValueError, KeyError, AttributeError) as error:
        raise InputError(
            f"{path} is damaged ({error}), expected what jobs/adapt.py writes; remove it and give "
            "--checkpoint and --shards"
        ) from None


def _path_from(index: str, path: str) -> str:
    return storage.absolute(storage.join(index, path)) if path.startswith("../") else path


def with_localizer(settings: S) -> S:
    """The settings with the index's own encoder, shards and surface model, where they name none.

    Raises InputError where the file beside the index is damaged.
    """
    found = read_localizer(settings.index)
    if found is None:
        return settings
    given = {"surface": settings.surface or usable_surface(settings.index, found.surface)}
    if settings.checkpoint == BUILTIN:
        given["checkpoint"] = found.checkpoint
    if settings.shards is None:
        given["shards"] = found.shards
    return replace(settings, **given)  # type: ignore[type-var]


def usable_surface(index: str, surface: str | None) -> str | None:
    """The surface model if it is there; a region may have been moved without it."""
    if surface is None or storage.exists(surface):
        return surface
    console.print(
        f"the surface model {surface} of {index} is not there: what stands above the ground is "
        "placed some metres beside; give it by --surface",
        style="yellow",
    )
    return None
