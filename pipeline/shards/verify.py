"""Is every byte of a set of shards what was packed? Each tar, count and hash is checked, and damage
named.

In: a folder or URI of shards. Out: what is wrong, a sentence each.
"""

import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import IO, cast

import ray

from pipeline.core import cluster, storage
from pipeline.core.errors import InputError
from pipeline.core.progress import progress
from pipeline.shards.manifest import Shard, first_three, read_manifest, write_damaged
from pipeline.shards.record_table import part_intact, read_part
from pipeline.shards.tar_reader import IMAGE_SUFFIXES, METADATA_SUFFIXES, HashedStream, read_members


def require_intact(shards: str, workers: int | None = None) -> None:
    """Look at every byte of a set. Raises InputError where one is not what was packed, as `verify`
    does besides.
    """
    _, wrong = verify(shards, workers)
    if wrong:
        raise InputError(
            f"{shards} is damaged in {len(wrong)} places: {first_three(wrong)}; run the command that packed it again "
            "(jobs/make_shards.py), which makes anew what is damaged"
        )


def verify(shards: str, workers: int | None = None) -> tuple[int, list[str]]:
    """How many shards there are, and what is wrong with them; nothing where all is well.

    The damaged ones are noted in the set, so that packing makes them anew. `workers`: Ray tasks at
    once, 0 for none: this process looks. Raises InputError when there is no manifest.
    """
    manifest, root = read_manifest(shards), storage.absolute(shards)
    found: list[tuple[str, str]] = []
    with progress(sum(shard.samples for shard in manifest.shards), "verifying") as meter:
        for shard, wrong in _check_all(root, manifest.shards, workers):
            found += [(shard.name, sentence) for sentence in wrong]
            meter.advance(shard.samples, damaged=len({name for name, _ in found}))
    with suppress(OSError):  # of a set that cannot be written to, somebody else's, nothing is noted
        write_damaged(shards, {name for name, _ in found})
    return len(manifest.shards), [sentence for _, sentence in sorted(found)]


def _check_all(
    root: str, shards: Sequence[Shard], workers: int | None
) -> Iterator[tuple[Shard, list[str]]]:
    if workers == 0:
        yield from ((shard, check_shard(root, shard)) for shard in shards)
        return
    cluster.connect()
    task = ray.remote(num_cpus=1)(check_shard)
    yield from cluster.bounded_map(
        lambda shard: task.remote(root, shard), shards, workers or 2 * cluster.cpus()
    )


def check_shard(root: str, shard: Shard) -> list[str]:
    """What is wrong with one tar and its record part."""
    path = storage.join(root, f"{shard.name}.tar")
    if not storage.exists(path):
        return [f"{path} is missing"]
    wrong: list[str] = []
    keys: list[tuple[str, str]] = []
    with storage.open_read(path) as stream:
        hashed = HashedStream(stream)
        try:
            for key, members in read_members(
                cast(IO[bytes], hashed), path, IMAGE_SUFFIXES + METADATA_SUFFIXES
            ):
                said = json.loads(members.pop("json"))["sha256"]
                [image] = members.values()
                keys.append((key, said))
                if hashlib.sha256(image).hexdigest() != said:
                    wrong.append(f"{path}: the image of {key} has not the hash that its JSON says")
        except InputError as error:
            wrong.append(str(error))
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            wrong.append(
                f"{path}: the sample behind {keys[-1][0] if keys else 'its beginning'} is damaged ({error})"
            )
        hashed.drain()
    if hashed.bytes != shard.bytes:
        wrong.append(f"{path} has {hashed.bytes} bytes, the manifest says {shard.bytes}")
    elif hashed.digest.hexdigest() != shard.sha256:
        wrong.append(f"{path} has not the hash that the manifest says")
    if len(keys) != shard.samples:
        wrong.append(f"{path} holds {len(keys)} images, the manifest says {shard.samples}")
    try:
        part = read_part(root, shard.name, ["key", "sha256"])
        if list(zip(part["key"].to_pylist(), part["sha256"].to_pylist(), strict=True)) != keys:
            wrong.append(f"the record table of {path} lists other images than it holds")
        if not part_intact(root, shard.name):
            wrong.append(f"the record table of {path} has a byte that packing did not write")
    except InputError as error:
        wrong.append(str(error))
    return wrong
