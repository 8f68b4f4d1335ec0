"""Shards that others made -> a manifest and facts in our words, so that they can be embedded as
they are.

In: a folder of tars in webdataset's layout without a manifest.json. Out: what read_manifest and a
JSON of ours would say.
"""

import math
import re
from collections.abc import Iterator, Mapping
from typing import IO, Any, cast

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.progress import console, progress
from pipeline.core.records import Split, View, escape_non_utf8, is_position, make_key
from pipeline.shards.manifest import MANIFEST, Manifest, Shard, read_manifest
from pipeline.shards.tar_reader import IMAGE_SUFFIXES, HashedStream, read_members

LOCATIONS = ("location", "label", "class", "class_name", "class_id", "place", "place_id", "id")
"Fields of a sample's JSON that may name what the image shows, the surest first."
LATITUDES, LONGITUDES = ("lat", "latitude"), ("lon", "lng", "longitude")
OUR_NAMES = re.compile(rf"({'|'.join(Split)})-({'|'.join(View)})-")
"How names begin that say a tar's split and view."


def open_manifest(shards: str, split: Split | None = None, view: View | None = None) -> Manifest:
    """The manifest of a set of shards; of one that others made, which has none, it is made by
    reading every tar once.

    Raises InputError where there is neither a manifest nor a tar, or tars alone and not both split
    and view are given: an interrupted packing of ours looks the same, and is not taken for a whole
    set.
    """
    if storage.exists(storage.join(shards, MANIFEST)):
        return read_manifest(shards)
    tars = [
        name.removesuffix(".tar") for name in storage.list_names(shards) if name.endswith(".tar")
    ]
    if not tars:
        return read_manifest(shards)  # which says what is missing
    if split is None or view is None:
        raise InputError(
            f"{shards} holds {len(tars)} tars and no {MANIFEST}: a packing that was interrupted, to be finished with "
            "jobs/make_shards.py, or shards that others made, of which expected both --split and --view; give them"
        )
    return scan_tars(shards, tars, split, view)


def scan_tars(shards: str, tars: list[str], split: Split, view: View) -> Manifest:
    """A manifest of tars that are all of this split and view but for those whose names say another.

    Raises InputError where two samples have one key, and as `read_tar` does.
    """
    console.print(
        f"{shards} has no {MANIFEST}: reading {len(tars)} tars as shards that others made, {split} {view}"
    )
    found: list[Shard] = []
    seen: dict[str, str] = {}  # key -> the tar that holds it
    with progress(len(tars), "reading", "tars") as meter:
        for name in tars:
            if (said := OUR_NAMES.match(name)) and said.groups() != (split, view):
                continue
            path, samples = storage.join(shards, f"{name}.tar"), 0
            with storage.open_read(path) as stream:
                hashed = HashedStream(stream)
                for key, _ in read_members(cast(IO[bytes], hashed), path, IMAGE_SUFFIXES):
                    samples += 1
                    if key in seen:
                        raise InputError(
                            f"sample {key} is in {seen[key]}.tar and again in {name}.tar of {shards}, expected keys that are "
                            "unique over the set; embed these tars from folders of their own, or give the samples other keys"
                        )
                    seen[key] = name
                hashed.drain()
            digest = hashed.digest.hexdigest()
            found.append(
                Shard(
                    name=name,
                    split=split,
                    view=view,
                    samples=samples,
                    bytes=hashed.bytes,
                    sha256=digest,
                )
            )
            meter.advance(samples=sum(shard.samples for shard in found))
    return Manifest(shards=tuple(found), classes=(), packing={"source": "others"}, rejected=0)


def external_metadata(
    key: str, said: Mapping[str, Any], label: bytes | None, split: Split, view: View
) -> dict[str, Any]:
    """What a JSON of ours would say of a sample, by its key, its JSON and its `.cls`.

    The location is the JSON's first field of LOCATIONS, else the label, else the key's folder, else
    the key: then every image is a place of its own. A position comes from plain numbers, at the top
    or in `geotag`.
    """
    folder, _, _ = key.rpartition("/")
    named = next(
        (
            str(said[name])
            for name in LOCATIONS
            if isinstance(said.get(name), str | int) and said[name] != ""
        ),
        "",
    )
    location = (
        named or (label or b"").decode(errors="replace").strip() or folder.rpartition("/")[2] or key
    )
    location = escape_non_utf8(location)  # JSON and names of files may hold half a character
    return {
        "key": make_key(split, view, location, key),
        "location": location,
        "view": view,
        "split": split,
        "geotag": _position(said)
        or (_position(said["geotag"]) if isinstance(said.get("geotag"), dict) else None),
        "source": "others",
    }


def _position(said: Mapping[str, Any]) -> dict[str, float] | None:
    lat, lon = (next(_numbers(said, names), math.nan) for names in (LATITUDES, LONGITUDES))
    return {"lat": float(lat), "lon": float(lon)} if is_position(lat, lon) else None


def _numbers(said: Mapping[str, Any], names: tuple[str, ...]) -> Iterator[float]:
    for name in names:
        if isinstance(value := said.get(name), int | float) and not isinstance(value, bool):
            yield value
