"""A shard's tar -> its samples: an image's bytes with the metadata beside it.

In: the path of a tar. Out: samples in their order.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO, Any, cast

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.integrity import HashingStream
from pipeline.core.records import KEY_PATTERN, Split, View, excerpt, is_position, is_utf8
from pipeline.shards.external import (
    external_metadata,
    find_metadata,
    find_suffixes,
    parse_json,
)
from pipeline.shards.manifest import repair_hint
from pipeline.shards.tar_reader import (
    ALL_SUFFIXES,
    IMAGE_SUFFIXES,
    METADATA_SUFFIXES,
    read_members,
    read_tar,
)

REQUIRED_FIELDS = {"key", "location", "view", "split", "geotag"}
"Fields of the JSON of a shard that jobs/make_shards.py packed."


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One image of a shard."""

    key: str
    data: bytes
    "The encoded image."
    metadata: dict[str, Any]
    "The JSON beside it; in shards that others made, derived from what they store."


def read_samples(
    tar: str,
    external: tuple[Split, View] | None = None,
    sha256: str | None = None,
    scattered: bool = False,
) -> Iterator[Sample]:
    """The samples of one tar in their order; members without an image are skipped.

    `external`: split and view of a tar that others made, whose samples do not state them.
    `scattered`: its metadata does not stand beside the images, and is read before them. Raises
    InputError where the tar is cut off or hostile, or where a sample is not one of ours and
    `external` is not given; after the last sample, where the tar's hash is not `sha256`.
    """
    folder = tar.rpartition("/")[0]
    apart: dict[str, dict[str, bytes]] = {}
    if scattered:
        for key, members in read_tar(tar, METADATA_SUFFIXES, external=True):
            apart.setdefault(key, {}).update(members)
    for key, members in _read_hashed(tar, external is not None, sha256):
        if not (images := find_suffixes(members, IMAGE_SUFFIXES)):
            continue
        data = members[images[0]]
        stated, label = find_metadata(apart.get(key, {}) | members)
        if stated.keys() >= REQUIRED_FIELDS:
            if wrong := next(_faults(key, stated), None):
                raise InputError(
                    f"the JSON of sample {key!r} in {tar} has {wrong}; {repair_hint(folder)}"
                )
            yield Sample(key=key, data=data, metadata=stated)
            continue
        if external is None:
            raise InputError(
                f"{tar} was not packed by jobs/make_shards.py: sample {key} has no JSON that says "
                f"{', '.join(sorted(REQUIRED_FIELDS))}; give its --split and --view, or pack its "
                "images with jobs/make_shards.py"
            )
        metadata = external_metadata(key, stated, label, *external)
        yield Sample(key=metadata["key"], data=data, metadata=metadata)


def _read_hashed(
    tar: str, external: bool, sha256: str | None
) -> Iterator[tuple[str, dict[str, bytes]]]:
    """`read_tar`, which compares the hash after the tar's end, if one is given."""
    if sha256 is None:
        yield from read_tar(tar, external=external)
        return
    with storage.open_read(tar) as stream:
        hashed = HashingStream(stream)
        yield from read_members(cast(IO[bytes], hashed), tar, ALL_SUFFIXES, external)
        hashed.drain()
    if hashed.checksum.sha256 != sha256:
        raise InputError(
            f"{tar} has not the hash that the manifest says, expected what was packed; "
            f"{repair_hint(tar.rpartition('/')[0])}"
        )


def read_locations(tar: str) -> Iterator[str]:
    """The locations of one tar's samples, without reading its images.

    Raises InputError where a sample does not state it, and as `read_tar` does.
    """
    for key, members in read_tar(tar, ("json",)):
        location = parse_json(members.get("json")).get("location")
        if not isinstance(location, str):
            raise InputError(
                f"{tar}: the JSON of {key!r} says no location, expected what was packed; "
                f"{repair_hint(tar.rpartition('/')[0])}"
            )
        yield location


def _faults(key: str, stated: dict[str, Any]) -> Iterator[str]:
    """The fields of a JSON that packing cannot have written so. Later code relies on all others."""
    if not KEY_PATTERN.fullmatch(key) or stated["key"] != key:
        yield f"the key {excerpt(stated['key'])}, expected that of its file"
    for name, allowed in (("view", View), ("split", Split)):
        if stated[name] not in list(allowed):
            yield f"the {name} {excerpt(stated[name])}, expected one of {', '.join(allowed)}"
    if not isinstance(stated["location"], str) or not is_utf8(stated["location"]):
        yield f"the location {excerpt(stated['location'])}, expected text"
    tag = stated["geotag"]
    valid = isinstance(tag, dict) and is_position(tag.get("lat"), tag.get("lon"))
    if tag is not None and not valid:
        yield f"the geotag {excerpt(tag)}, expected null or a latitude and a longitude in degrees"
    corners = tag.get("footprint") if valid else None
    if corners is not None and not _is_outline(corners):
        yield f"the footprint {excerpt(corners)}, expected null or four positions in degrees"


def _is_outline(corners: Any) -> bool:
    return (
        isinstance(corners, list)
        and len(corners) == 4
        and all(isinstance(one, list) and len(one) == 2 and is_position(*one) for one in corners)
    )
