"""The folder of a region: what lies where, and the command that makes each part alone."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from jobs.region.settings import AdaptSettings
from pipeline.core import json_files, storage
from pipeline.core.errors import InputError
from pipeline.core.progress import console
from pipeline.simulation.resume import settings_record
from pipeline.sources.maps.sheets import describe_sheets, find_sheets, read_sheet

PATHS = {"mosaic", "surface"}
"Settings whose files may have been moved since."


@dataclass(frozen=True, kw_only=True)
class Region:
    """The folder of a region and what lies in it."""

    out: str

    def path(self, *names: str) -> str:
        return storage.join(self.out, *names)

    @cached_property
    def tiles(self) -> str:
        return self.path("tiles")

    @cached_property
    def table(self) -> str:
        return self.path("table")

    @cached_property
    def index(self) -> str:
        return self.path("index")

    @cached_property
    def encoder(self) -> str:
        return self.path("encoder.safetensors")


def with_absolute_paths(settings: AdaptSettings) -> AdaptSettings:
    """The settings for processes in other folders, and for a rerun from another one."""
    surface, photos = settings.surface, settings.photos
    return replace(
        settings,
        mosaic=storage.absolute(settings.mosaic),
        out=storage.absolute(settings.out),
        surface=surface and storage.absolute(surface),
        photos=photos and storage.absolute(photos),
    )


def check_map(settings: AdaptSettings) -> list[str]:
    """The files of the map. Raises InputError where there is none, a folder that does not hold the
    sheets of one, or no surface model where one is named."""
    if settings.surface is not None and not storage.exists(settings.surface):
        raise InputError(
            f"no surface model at {settings.surface}, expected a GeoTIFF, or a folder of its "
            "sheets; check --surface, or leave it out: the ground is taken for flat then"
        )
    if not storage.exists(settings.mosaic):
        raise InputError(
            f"no map at {settings.mosaic}, expected a GeoTIFF, or a folder of its sheets; check "
            "--mosaic"
        )
    if not storage.is_folder(settings.mosaic):
        return [settings.mosaic]
    files = find_sheets(settings.mosaic)
    describe_sheets([read_sheet(path) for path in files])
    return files


def claim(region: Region, settings: AdaptSettings, is_finished: Callable[[], bool]) -> None:
    """Note the region's settings in its folder. `is_finished`: of the same map, wherever that lies
    now; asked only where a path is another one.

    Raises InputError where it is of other settings or another map, or where there is no map.
    """
    about = (
        settings_record(settings, ("out", "extend", "camera"))
        | settings.lens
        | {"mosaic_bytes": sum(map(storage.size, check_map(settings)))}
    )
    path = region.path("region.json")
    if not storage.exists(path):
        if storage.is_folder(region.out) and storage.walk(region.out):
            raise InputError(
                f"{region.out} holds files of something else, expected a new or empty folder; "
                "choose another --out"
            )
        Path(region.out).mkdir(parents=True, exist_ok=True)
        json_files.write_checksummed(path, about)
        return
    try:
        found = json_files.read_checksummed(path)
    except ValueError as error:
        raise InputError(
            f"{path} is damaged ({error}), expected the settings of a region; remove the folder "
            "and adapt again"
        ) from None
    differing = sorted(name for name in {*found, *about} if found.get(name) != about.get(name))
    if differing and not (PATHS.issuperset(differing) and is_finished()):
        raise InputError(
            f"{region.out} was adapted with another {', '.join(differing)}, expected the same "
            "settings to resume; choose another --out or remove the folder"
        )


def print_command(name: str, **flags: object) -> None:
    """Print the command that runs a stage alone."""
    words = []
    for flag, value in flags.items():
        values = [] if value is True else value if isinstance(value, (list, tuple)) else [value]
        words += [f"--{flag.replace('_', '-')}", *map(str, values)]
    console.print(f"pvda {name} {' '.join(words)}", style="dim", markup=False, soft_wrap=True)
