"""Verification of a set of shards: every tar, count and hash is checked, and damage is named.

In: a ShardSet. Out: a sentence for each damage.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import IO, cast

import ray

from pipeline.core import cluster, storage
from pipeline.core.errors import InputError
from pipeline.core.integrity import HashingStream, sha256_of
from pipeline.core.progress import progress
from pipeline.shards.manifest import Shard, write_damaged
from pipeline.shards.record_table import part_intact, read_part
from pipeline.shards.shard_set import ShardSet, first_three
from pipeline.shards.tar_reader import IMAGE_SUFFIXES, METADATA_SUFFIXES, read_members


def require_intact(shards: ShardSet, workers: int | None = None) -> None:
    """Check every byte of a set. Raises InputError where one is not what was packed."""
    if wrong := verify(shards, workers):
        raise InputError(
            f"{shards.path} is damaged in {len(wrong)} places: {first_three(wrong)}; run the "
            "command that packed it again (jobs/make_shards.py), which repairs the damaged shards"
        )


def verify(shards: ShardSet, workers: int | None = None) -> list[str]:
    """Check every byte of a set; returns a sentence for each damage.

    The damaged shards are listed in the set, so that packing repairs them. `workers`: Ray tasks at
    once, 0 for none: this process checks.
    """
    found: list[tuple[str, str]] = []
    checked = shards.manifest.shards
    with progress(sum(shard.samples for shard in checked), "verifying") as meter:
        for shard, wrong in _check_all(storage.absolute(shards.path), checked, workers):
            found += [(shard.name, sentence) for sentence in wrong]
            meter.advance(shard.samples, damaged=len({name for name, _ in found}))
    with suppress(OSError):  # a set of somebody else, which cannot be written to
        write_damaged(shards.path, {name for name, _ in found})
    return [sentence for _, sentence in sorted(found)]


def _check_all(
    root: str, shards: Sequence[Shard], workers: int | None
) -> Iterator[tuple[Shard, list[str]]]:
    if workers == 0:
        yield from ((shard, check_shard(root, shard)) for shard in shards)
        return
    cluster.connect()
    task = ray.remote(num_cpus=1)(check_shard)
    window = workers or 2 * cluster.cpus()
    yield from cluster.bounded_map(lambda shard: task.remote(root, shard), shards, window)


def check_shard(root: str, shard: Shard) -> list[str]:
    """A sentence for each damage of one tar and its record part."""
    path = storage.join(root, f"{shard.name}.tar")
    if not storage.exists(path):
        return [f"{path} is missing"]
    wrong: list[str] = []
    images: list[tuple[str, str]] = []  # key and sha256
    with storage.open_read(path) as stream:
        hashed = HashingStream(stream)
        suffixes = IMAGE_SUFFIXES + METADATA_SUFFIXES
        try:
            for key, members in read_members(cast(IO[bytes], hashed), path, suffixes):
                stated = json.loads(members.pop("json"))["sha256"]
                [image] = members.values()
                images.append((key, stated))
                if sha256_of(image) != stated:
                    wrong.append(f"{path}: the image of {key} has not the hash that its JSON says")
        except InputError as error:
            wrong.append(str(error))
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            after = images[-1][0] if images else "its beginning"
            wrong.append(f"{path}: the sample behind {after} is damaged ({error})")
        hashed.drain()
    found = hashed.checksum
    if found.bytes != shard.bytes:
        wrong.append(f"{path} has {found.bytes} bytes, the manifest says {shard.bytes}")
    elif found.sha256 != shard.sha256:
        wrong.append(f"{path} has not the hash that the manifest says")
    if len(images) != shard.samples:
        wrong.append(f"{path} holds {len(images)} images, the manifest says {shard.samples}")
    return wrong + _check_records(root, shard, path, images)


def _check_records(root: str, shard: Shard, tar: str, images: list[tuple[str, str]]) -> list[str]:
    """A sentence for each damage of a shard's record part. `images`: what its tar holds."""
    wrong = []
    try:
        part = read_part(root, shard.name, ["key", "sha256"])
        if list(zip(part["key"].to_pylist(), part["sha256"].to_pylist(), strict=True)) != images:
            wrong.append(f"the record table of {tar} lists other images than it holds")
        if not part_intact(root, shard.name):
            wrong.append(f"the record table of {tar} has a byte that packing did not write")
    except InputError as error:
        wrong.append(str(error))
    return wrong
