"""The maps of a region: by what one is known again, what a person calls it, and the path by which
it is read.

In: --mosaic and --surface, files or folders of sheets. Out: paths of one file each, identities.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from jobs.encoding.localizer import read_localizer, usable_surface
from jobs.region.folder import Region
from jobs.region.settings import AdaptSettings
from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.integrity import checksum_file
from pipeline.core.progress import console
from pipeline.sources.maps.sheets import as_one_map, find_sheets, join_sheets


@dataclass(frozen=True, kw_only=True)
class RegionMap:
    """A map that a region was made of. It has no path: map and region may be moved."""

    name: str
    "Of its file or folder, after that of the folder above."
    sha256: str
    "Of its bytes; of a folder of the bytes of its sheets."
    surface_sha256: str | None = None
    "Likewise of its surface model, if any. Regions from before have none noted."

    @property
    def stem(self) -> str:
        """The beginning of its tiles' names."""
        return self.name.rpartition("/")[2].rsplit(".", 1)[0]


def identify_map(mosaic: str, surface: str | None = None) -> RegionMap:
    """The map, and its surface model, at absolute paths; reads all of both."""
    return RegionMap(
        name="/".join(mosaic.rstrip("/").split("/")[-2:]),
        sha256=_digest(mosaic),
        surface_sha256=None if surface is None else _digest(surface),
    )


def _digest(path: str) -> str:
    if not storage.is_folder(path):
        return checksum_file(path).sha256
    sheets = [checksum_file(sheet).sha256 for sheet in find_sheets(path)]
    return hashlib.sha256("".join(sheets).encode()).hexdigest()


def maps_of(figures: Mapping[str, Any]) -> list[RegionMap]:
    """The maps of a region by its figures; none where it is not finished, or is of a release that
    noted none."""
    return [RegionMap(**one) for one in figures.get("maps", ()) if isinstance(one, dict)]


def titles_of(maps: Sequence[RegionMap]) -> list[str]:
    """What a page calls each map: its file's name, where that tells it from the others; else with
    its folder's, and where that is the same too with a number."""
    short = [one.name.rpartition("/")[2] for one in maps]
    names = [name if short.count(name) == 1 else one.name
             for name, one in zip(short, maps, strict=True)]  # fmt: skip
    return [
        name if names.count(name) == 1 else f"{name} ({names[:at].count(name) + 1})"
        for at, name in enumerate(names)
    ]


def with_one_file_each(
    region: Region, settings: AdaptSettings, known: Sequence[RegionMap] = ()
) -> AdaptSettings:
    """The settings with map and surface model as one file each. A folder's is a VRT in the region;
    so is that of a map whose tiles would be called as those of another in the region.

    Raises InputError for a folder without sheets of one map.
    """
    stem = RegionMap(name=settings.mosaic.rpartition("/")[2], sha256="").stem
    taken = stem in {one.stem for one in known}
    if taken:
        stem += f"-{len(known)}"
    vrt = region.path("maps", f"{stem}.vrt")
    mosaic, surface = as_one_map(settings.mosaic, vrt), settings.surface
    return replace(
        settings,
        mosaic=join_sheets([mosaic], vrt) if taken and mosaic != vrt else mosaic,
        surface=surface and as_one_map(surface, region.path("maps", f"{stem}-surface.vrt")),
    )


def join_surfaces(region: Region, surface: str | None, known: int) -> str | None:
    """The surface model of a region of `known` maps and of another one: a VRT of both where both
    have one. Where they are of different grids, that of the region, with a message."""
    noted = read_localizer(region.index)
    before = usable_surface(region.index, noted.surface) if noted else None
    if before is None or surface is None:
        return before or surface
    try:
        return join_sheets([before, surface], region.path("maps", f"surface-{known}.vrt"))
    except InputError as error:
        console.print(
            f"heights are known of the first map alone: {surface} does not join {before} ({error})",
            style="yellow",
        )
        return before
