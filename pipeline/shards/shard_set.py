"""A set of shards, opened once: everything that reads shards goes through it.

In: a folder or URI. Out: a ShardSet with its manifest, samples, images by key and record table.
"""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import pyarrow as pa

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.shards import record_table
from pipeline.shards.external import ARCHIVE, EXTERNAL, TAR_ENDINGS, scan_tars
from pipeline.shards.manifest import MANIFEST, Manifest, Shard, read_manifest, repair_hint
from pipeline.shards.samples import Sample, read_locations, read_samples


@dataclass(frozen=True, kw_only=True)
class ShardSet:
    """A finished set of shards. It holds no open files and can be sent to other processes."""

    keys_state_location: ClassVar[bool] = True
    "Whether a sample's key names its location, so that the two can be compared."
    path: str
    "Folder or URI."
    manifest: Manifest

    @property
    def external(self) -> bool:
        """Whether others made these shards, so that there is neither a manifest on disk nor a
        record table.
        """
        return self.manifest.packing.get("source") == EXTERNAL

    @property
    def repair_hint(self) -> str:
        """The commands that repair damaged shards, for the end of an error message."""
        return repair_hint(self.path)

    def tar(self, shard: Shard) -> str:
        """Path of a shard's tar."""
        return storage.join(self.path, self._file(shard))

    def samples(self, shard: Shard, verify: bool = False) -> Iterator[Sample]:
        """The samples of one shard in their order; members without an image are skipped.

        With `verify`, the tar's hash is compared with the manifest's after the last sample. Raises
        InputError where the tar is damaged, hostile, or has other content than the manifest says.
        """
        return read_samples(
            self.tar(shard),
            external=(shard.split, shard.view) if self.external else None,
            sha256=shard.sha256 if verify else None,
            scattered=self.external and shard.name in self.manifest.packing["scattered"],
        )

    def locations(self, shard: Shard) -> Iterator[str]:
        """The locations of one shard's samples, without reading its images."""
        return read_locations(self.tar(shard))

    def has_records(self, shard: Shard) -> bool:
        return record_table.has_part(self.path, shard.name)

    def records(self, shard: Shard, columns: list[str] | None = None) -> pa.Table:
        """The record table's rows of one shard.

        Raises InputError where they cannot be read.
        """
        return record_table.read_part(self.path, shard.name, columns)

    def column(self, name: str) -> dict[str, Any]:
        """One column of the record table, by key."""
        found: dict[str, Any] = {}
        for shard in self.manifest.shards:
            table = self.records(shard, ["key", name])
            found.update(zip(table["key"].to_pylist(), table[name].to_pylist(), strict=True))
        return found

    def export(self, file: str) -> tuple[int, int]:
        """Write the record table as one file, `.parquet` or `.geojson`.

        Returns how many images were written, and how many have no position and were skipped.
        """
        return record_table.export(map(self.records, self.manifest.shards), file)

    def missing_tars(self, shards: Iterable[Shard]) -> dict[str, str]:
        """By shard name, a sentence for each tar that is absent or has another size than the
        manifest says. Lists the folder once.
        """
        sizes, wrong = storage.walk(self.path), dict[str, str]()
        for shard in shards:
            path, size = self.tar(shard), sizes.get(self._file(shard))
            if size is None:
                wrong[shard.name] = f"{path} is missing"
            elif size != shard.bytes:
                wrong[shard.name] = f"{path} has {size} bytes, the manifest says {shard.bytes}"
        return wrong

    def require_tars(self, shards: Iterable[Shard]) -> None:
        """Raise InputError where tars are absent or have another size than the manifest says."""
        if wrong := self.missing_tars(shards):
            raise InputError(
                f"{len(wrong)} shards cannot be used: {first_three(wrong.values())}; "
                f"{self.repair_hint}"
            )

    def for_workers(self) -> "ShardSet":
        """The set without its list of shards, which may be long, for workers that are given one
        shard at a time.
        """
        return replace(self, manifest=replace(self.manifest, shards=(), classes=()))

    def _file(self, shard: Shard) -> str:
        files: dict[str, str] = self.manifest.packing.get("files", {}) if self.external else {}
        return files.get(shard.name, f"{shard.name}.tar")


def open_shards(path: str) -> ShardSet:
    """Open a set that jobs/make_shards.py packed.

    Raises InputError when it has no manifest or one that cannot be read.
    """
    return ShardSet(path=path, manifest=read_manifest(path))


def open_or_scan(path: str, split: Split | None = None, view: View | None = None) -> ShardSet:
    """Open a set of shards; one that others made has no manifest, and is read once to make it.

    Raises InputError where there is neither a manifest nor a tar, but perhaps archives of other
    kinds or tars in folders below it, or where there are only tars and
    not both split and view are given: an interrupted packing of ours looks the same, and must not
    pass for a complete set.
    """
    if storage.exists(storage.join(path, MANIFEST)):
        return open_shards(path)
    files = storage.walk(path) if storage.is_folder(path) else {}
    tars = [name for name in files if name.endswith(TAR_ENDINGS) and "/" not in name]
    others = [name for name in files if ARCHIVE.search(name) and name not in tars]
    if others and not tars:
        raise InputError(
            f"{path} holds {len(others)} archives that are not read here, {others[0]} first, "
            "expected .tar, .tar.gz or .tgz directly in it; name the folder of the tars, or "
            "convert the archives"
        )
    if not tars:
        return open_shards(path)  # raises, and says what is missing
    if split is None or view is None:
        raise InputError(
            f"{path} holds {len(tars)} tars and no {MANIFEST}: a packing that was interrupted, to "
            "be finished with jobs/make_shards.py, or shards that others made, of which expected "
            "both --split and --view; give them"
        )
    return ShardSet(path=path, manifest=scan_tars(path, tars, split, view, others))


def first_three(sentences: Collection[str]) -> str:
    """The first three sentences, and how many more there are."""
    listed = list(sentences)
    return "; ".join(listed[:3]) + (f"; and {len(listed) - 3} more" if len(listed) > 3 else "")
