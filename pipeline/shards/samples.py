"""A shard -> its images with what is known of them, whoever packed it.

In: one tar, by name. Out: samples in their order.
"""

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import IO, Any, cast

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import KEY_PATTERN, Split, View, excerpt, is_position, is_utf8
from pipeline.shards.external import external_metadata
from pipeline.shards.manifest import read_manifest, repair_hint
from pipeline.shards.tar_reader import (
    IMAGE_SUFFIXES,
    METADATA_SUFFIXES,
    HashedStream,
    read_members,
    read_tar,
)

REQUIRED_FIELDS = {"key", "location", "view", "split", "geotag"}
"What the JSON of a shard of ours says at least."


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One image as a shard holds it."""

    key: str
    data: bytes
    "The encoded image."
    facts: dict[str, Any]
    "The JSON beside it; of shards that others made, what could be found out in its words."


def read_shard(
    shards: str,
    name: str,
    split: Split | None = None,
    view: View | None = None,
    sha256: str | None = None,
) -> Iterator[Sample]:
    """The samples of one tar in their order; what has no image is none.

    `split` and `view` are those of a tar that others made, whose samples do not say; of ours they are not needed. Raises
    InputError where the tar is cut off or hostile, or where the samples are another's and it was not said what they are; behind
    the last one, where the tar's hash is not `sha256`.
    """
    path = storage.join(shards, f"{name}.tar")
    for key, members in read_tar(path) if sha256 is None else _read_whole(shards, path, sha256):
        data = next((members[ending] for ending in IMAGE_SUFFIXES if ending in members), None)
        if data is None:
            continue
        said = _json(members.get("json"))
        if said.keys() >= REQUIRED_FIELDS:
            if wrong := next(_faults(key, said), None):
                raise InputError(
                    f"the JSON of sample {key!r} in {path} has {wrong}; {repair_hint(shards)}"
                )
            yield Sample(key=key, data=data, facts=said)
            continue
        if split is None or view is None:
            raise InputError(
                f"{path} was not packed by jobs/make_shards.py: sample {key} has no JSON that says {', '.join(sorted(REQUIRED_FIELDS))}; "
                "give its --split and --view, or pack its images with jobs/make_shards.py"
            )
        facts = external_metadata(key, said, members.get("cls"), split, view)
        yield Sample(key=facts["key"], data=data, facts=facts)


def _read_whole(shards: str, path: str, sha256: str) -> Iterator[tuple[str, dict[str, bytes]]]:
    """`read_tar`, and behind its end the hash is compared."""
    with storage.open_read(path) as stream:
        hashed = HashedStream(stream)
        yield from read_members(cast(IO[bytes], hashed), path, IMAGE_SUFFIXES + METADATA_SUFFIXES)
        hashed.drain()
    if hashed.digest.hexdigest() != sha256:
        raise InputError(
            f"{path} has not the hash that the manifest says, expected what was packed; {repair_hint(shards)}"
        )


def read_locations(shards: str, name: str) -> Iterator[str]:
    """The locations of one tar's samples, without reading its images.

    Raises InputError where a sample does not say, and as `read_tar` does.
    """
    path = storage.join(shards, f"{name}.tar")
    for key, members in read_tar(path, ("json",)):
        location = _json(members.get("json")).get("location")
        if not isinstance(location, str):
            raise InputError(
                f"{path}: the JSON of {key!r} says no location, expected what was packed; {repair_hint(shards)}"
            )
        yield location


def _faults(key: str, said: dict[str, Any]) -> Iterator[str]:
    """What of the JSON of a shard of ours cannot be as packing wrote it: whoever reads on may rely
    on the rest.
    """
    if not KEY_PATTERN.fullmatch(key) or said["key"] != key:
        yield f"the key {excerpt(said['key'])}, expected that of its file"
    for name, allowed in (("view", View), ("split", Split)):
        if said[name] not in list(allowed):
            yield f"the {name} {excerpt(said[name])}, expected one of {', '.join(allowed)}"
    if not isinstance(said["location"], str) or not is_utf8(said["location"]):
        yield f"the location {excerpt(said['location'])}, expected text"
    tag = said["geotag"]
    if tag is not None and not (
        isinstance(tag, dict) and is_position(tag.get("lat"), tag.get("lon"))
    ):
        yield f"the geotag {excerpt(tag)}, expected null or a latitude and a longitude in degrees"


def _json(data: bytes | None) -> dict[str, Any]:
    """A JSON object; nothing where there is none or it is none."""
    try:
        said = json.loads(data or b"{}")
    except (ValueError, RecursionError):
        return {}
    return said if isinstance(said, dict) else {}


def fetch(shards: str, keys: Iterable[str]) -> dict[str, bytes]:
    """The encoded images of some keys; keys that no shard holds are absent."""
    wanted = set(keys)
    found: dict[str, bytes] = {}
    for shard in read_manifest(shards).shards:
        prefix = f"{shard.split}-{shard.view}-"
        if any(key.startswith(prefix) for key in wanted):
            members = read_tar(storage.join(shards, f"{shard.name}.tar"), IMAGE_SUFFIXES)
            found |= {key: next(iter(images.values())) for key, images in members if key in wanted}
    return found
