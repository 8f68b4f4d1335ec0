"""Single images of a set of shards, and the ground that they show, by random access.

In: a set of shards that jobs/make_shards.py packed. Out: encoded images and footprints of some
keys. The first call reads the keys of the record tables, and the first one of a shard the headers
of its tar; pages and matching then read the images that they need and no others.
"""

import tarfile
from collections.abc import Iterable
from functools import lru_cache
from typing import IO

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import View
from pipeline.shards.manifest import Shard
from pipeline.shards.shard_set import ShardSet
from pipeline.shards.tar_reader import IMAGE_SUFFIXES

SHARDS_IN_MEMORY = 256
"Shards whose member offsets and footprints are kept: some 1,000 images each."
Span = tuple[int, int]
"Offset and size of a tar's member, bytes."


class TileReader:
    """Reads images by their keys. Not for shards that others made: these have no record table."""

    def __init__(self, shards: ShardSet, view: View | None = None) -> None:
        """`view`: only shards of it, all by default. Raises InputError for shards of others."""
        if shards.external:
            raise InputError(
                f"{shards.path} was packed by another program, expected shards of "
                "jobs/make_shards.py, which know the ground of each tile; pack the map with it"
            )
        self._shards = {
            shard.name: shard
            for shard in shards.manifest.shards
            if view is None or shard.view == view
        }
        self._set = shards
        self._shard_of: dict[str, str] | None = None
        self._spans = lru_cache(maxsize=SHARDS_IN_MEMORY)(self._read_spans)
        self._footprints = lru_cache(maxsize=SHARDS_IN_MEMORY)(self._read_footprints)

    def fetch(self, keys: Iterable[str]) -> dict[str, bytes]:
        """The encoded images of some keys; unknown keys are absent."""
        found: dict[str, bytes] = {}
        for name, wanted in self._by_shard(keys).items():
            spans = self._spans(name)
            with storage.open_read(self._set.tar(self._shards[name])) as stream:
                found |= {key: _read_span(stream, spans[key]) for key in wanted if key in spans}
        return found

    def footprints(self, keys: Iterable[str]) -> dict[str, list[list[float]]]:
        """Corners (lat, lon) of the ground that some images show, from the upper left clockwise;
        unknown ones are absent."""
        found: dict[str, list[list[float]]] = {}
        for name, wanted in self._by_shard(keys).items():
            known = self._footprints(name)
            found |= {key: known[key] for key in wanted if key in known}
        return found

    def _by_shard(self, keys: Iterable[str]) -> dict[str, list[str]]:
        if self._shard_of is None:
            self._shard_of = {
                key: name for name, shard in self._shards.items() for key in self._keys(name, shard)
            }
        grouped: dict[str, list[str]] = {}
        for key in keys:
            if key in self._shard_of:
                grouped.setdefault(self._shard_of[key], []).append(key)
        return grouped

    def _keys(self, name: str, shard: Shard) -> list[str]:
        if not self._set.has_records(shard):  # then the tar itself tells
            return list(self._spans(name))
        return list(self._set.records(shard, ["key"])["key"].to_pylist())

    def _read_spans(self, name: str) -> dict[str, Span]:
        path = self._set.tar(self._shards[name])
        try:
            with storage.open_read(path) as stream, tarfile.open(fileobj=stream) as tar:
                return {
                    member.name.partition(".")[0]: (member.offset_data, member.size)
                    for member in tar
                    if member.name.rpartition(".")[2] in IMAGE_SUFFIXES
                }
        except tarfile.TarError as error:
            raise InputError(
                f"{path} cannot be read ({error}), expected the tar that packing wrote; "
                f"{self._set.repair_hint}"
            ) from None

    def _read_footprints(self, name: str) -> dict[str, list[list[float]]]:
        table = self._set.records(self._shards[name], ["key", "footprint"])
        pairs = zip(table["key"].to_pylist(), table["footprint"].to_pylist(), strict=True)
        return {key: footprint for key, footprint in pairs if footprint is not None}


def _read_span(stream: IO[bytes], span: Span) -> bytes:
    offset, size = span
    stream.seek(offset)
    return stream.read(size)
