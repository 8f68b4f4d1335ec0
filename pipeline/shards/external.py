"""Shards that others made -> a manifest and metadata in this project's terms, so that they can be
embedded as they are.

In: a folder of tars in webdataset's layout without a manifest.json. Out: the manifest that packing
would have written, and per sample the JSON that it would have written.
"""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import IO, Any, cast

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.integrity import HashingStream
from pipeline.core.progress import console, progress
from pipeline.core.records import Split, View, escape_non_utf8, is_position, make_key
from pipeline.shards.manifest import MANIFEST, Manifest, Shard
from pipeline.shards.tar_reader import IMAGE_SUFFIXES, read_members

EXTERNAL = {"source": "others"}
"The packing settings in the manifest of shards that others made."
LOCATIONS = ("location", "label", "class", "class_name", "class_id", "place", "place_id", "id")
"Fields of a sample's JSON that may name the place it shows, the most reliable first."
LATITUDES, LONGITUDES = ("lat", "latitude"), ("lon", "lng", "longitude")
OUR_NAMES = re.compile(rf"({'|'.join(Split)})-({'|'.join(View)})-")
"Tar names that state a split and a view."


def scan_tars(folder: str, tars: list[str], split: Split, view: View) -> Manifest:
    """A manifest of the tars of this split and view: all but those whose names state another.

    Raises InputError where two samples have one key, and as `read_tar` does.
    """
    console.print(
        f"{folder} has no {MANIFEST}: reading {len(tars)} tars as shards that others made, "
        f"{split} {view}"
    )
    found: list[Shard] = []
    seen: dict[str, str] = {}  # key -> the tar that holds it
    with progress(len(tars), "reading", "tars") as meter:
        for name in tars:
            if (stated := OUR_NAMES.match(name)) and stated.groups() != (split, view):
                continue
            path, samples = storage.join(folder, f"{name}.tar"), 0
            with storage.open_read(path) as stream:
                hashed = HashingStream(stream)
                for key, _ in read_members(cast(IO[bytes], hashed), path, IMAGE_SUFFIXES):
                    samples += 1
                    if key in seen:
                        raise InputError(
                            f"sample {key} is in {seen[key]}.tar and again in {name}.tar of "
                            f"{folder}, expected keys that are unique over the set; embed these "
                            "tars from folders of their own, or give the samples other keys"
                        )
                    seen[key] = name
                hashed.drain()
            found.append(
                Shard(
                    name=name, split=split, view=view, samples=samples,
                    **asdict(hashed.checksum),
                )
            )  # fmt: skip
            meter.advance(samples=sum(shard.samples for shard in found))
    return Manifest(shards=tuple(found), classes=(), packing=EXTERNAL, rejected=0)


def external_metadata(
    key: str, stated: Mapping[str, Any], label: bytes | None, split: Split, view: View
) -> dict[str, Any]:
    """The JSON that packing would have written for a sample, from its key, its JSON and its `.cls`.

    The location is the JSON's first field of LOCATIONS, else the label, else the key's folder, else
    the key, so that every image is a location of its own. The position is read from plain numbers,
    at the top level or in `geotag`.
    """
    folder, _, _ = key.rpartition("/")
    named = next(
        (
            str(stated[name])
            for name in LOCATIONS
            if isinstance(stated.get(name), str | int) and stated[name] != ""
        ),
        "",
    )
    location = (
        named or (label or b"").decode(errors="replace").strip() or folder.rpartition("/")[2] or key
    )
    location = escape_non_utf8(location)  # JSON and names of files may hold half a character
    nested = stated.get("geotag")
    return {
        "key": make_key(split, view, location, key),
        "location": location,
        "view": view,
        "split": split,
        "geotag": _position(stated) or (_position(nested) if isinstance(nested, dict) else None),
        "source": "others",
    }


def _position(stated: Mapping[str, Any]) -> dict[str, float] | None:
    lat, lon = (next(_numbers(stated, names), math.nan) for names in (LATITUDES, LONGITUDES))
    return {"lat": float(lat), "lon": float(lon)} if is_position(lat, lon) else None


def _numbers(stated: Mapping[str, Any], names: tuple[str, ...]) -> Iterator[float]:
    for name in names:
        if isinstance(value := stated.get(name), int | float) and not isinstance(value, bool):
            yield value
