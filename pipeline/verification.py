"""Is every byte of a set of shards what was packed? Each tar, count and hash is checked, and damage named.

In: a folder or URI of shards. Out: what is wrong, a sentence each.
"""

import hashlib
import json
import tarfile
from collections.abc import Iterator
from typing import IO, cast

import ray

from pipeline import cluster, storage
from pipeline.progress import progress
from pipeline.records import InputError
from pipeline.shard_records import read_part
from pipeline.shards import Shard, read_manifest


def verify(shards: str) -> tuple[int, list[str]]:
    """How many shards there are, and what is wrong with them; nothing where all is well.

    Raises InputError when there is no manifest.
    """
    manifest, root = read_manifest(shards), storage.absolute(shards)
    found: list[tuple[str, str]] = []
    cluster.connect()
    task = ray.remote(num_cpus=1)(check_shard)
    with progress(sum(shard.samples for shard in manifest.shards), "verifying") as meter:
        calls = cluster.bounded(lambda shard: task.remote(root, shard), manifest.shards, 2 * cluster.cpus())
        for shard, wrong in calls:
            found += [(shard.name, sentence) for sentence in wrong]
            meter.advance(shard.samples, damaged=len({name for name, _ in found}))
    return len(manifest.shards), [sentence for _, sentence in sorted(found)]


def check_shard(root: str, shard: Shard) -> list[str]:
    """What is wrong with one tar and its record part."""
    path = storage.join(root, f"{shard.name}.tar")
    if not storage.exists(path):
        return [f"{path} is missing"]
    wrong: list[str] = []
    try:
        parted = read_part(root, shard.name, ["key", "sha256"])
    except InputError as error:
        wrong.append(str(error))
        parted = None
    digest, keys, size = hashlib.sha256(), [], 0
    with storage.open_read(path) as stream:
        hashed = _Hashed(stream, digest)
        try:
            for key, found, said in images_of(hashed):
                keys.append((key, said))
                if found != said:
                    wrong.append(f"{path}: the image of {key} has not the hash that its JSON says")
        except (tarfile.TarError, EOFError, KeyError, ValueError) as error:
            wrong.append(f"{path} cannot be read behind {keys[-1][0] if keys else 'its beginning'} ({error})")
        while hashed.read(1 << 20):
            pass
        size = hashed.bytes
    if size != shard.bytes:
        wrong.append(f"{path} has {size} bytes, the manifest says {shard.bytes}")
    elif digest.hexdigest() != shard.sha256:
        wrong.append(f"{path} has not the hash that the manifest says")
    if len(keys) != shard.samples:
        wrong.append(f"{path} holds {len(keys)} images, the manifest says {shard.samples}")
    if parted is not None and list(zip(*(parted[name].to_pylist() for name in ("key", "sha256")), strict=True)) != keys:
        wrong.append(f"the record table of {path} lists other images than it holds")
    return wrong


def images_of(stream: "_Hashed") -> Iterator[tuple[str, str, str]]:
    """Of each image in a tar: its key, the hash of its bytes, and the hash that its JSON says.

    Raises tarfile.TarError and its kind on damage.
    """
    image = ""
    with tarfile.open(fileobj=cast(IO[bytes], stream), mode="r|") as tar:
        for member in tar:
            opened = tar.extractfile(member)
            data = opened.read() if opened is not None else b""
            if len(data) != member.size:
                raise tarfile.ReadError(f"{member.name} is cut off")
            if not member.name.endswith(".json"):
                image = hashlib.sha256(data).hexdigest()
                continue
            said = json.loads(data)
            yield said["key"], image, said["sha256"]


class _Hashed:
    """A stream that counts and hashes what is read from it."""

    def __init__(self, stream: IO[bytes], digest: "hashlib._Hash") -> None:
        self._stream, self._digest, self.bytes = stream, digest, 0

    def read(self, size: int) -> bytes:
        data = self._stream.read(size)
        self._digest.update(data)
        self.bytes += len(data)
        return data
