"""The manifest of a set of shards: its tars with their sizes and hashes, its classes, its settings.

In: a folder or URI. Out: the Manifest. Packing writes it last; a `ShardSet` holds it.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from pipeline.core import json_files, storage
from pipeline.core.errors import InputError
from pipeline.core.json_files import from_json, is_file_name
from pipeline.core.records import Split, View, excerpt

SCHEMA_VERSION = 2
MANIFEST = "manifest.json"
DAMAGED_FILE = "damaged.json"
"""Names of the shards that verification found damaged: packing repairs them and removes the file.
"""


@dataclass(frozen=True, kw_only=True)
class Shard:
    """One tar as the manifest describes it."""

    name: str
    "Without `.tar`; a feature table's part has the same."
    split: Split
    view: View
    samples: int
    bytes: int
    sha256: str


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """The content of a set of shards."""

    shards: tuple[Shard, ...]
    classes: tuple[str, ...]
    """Locations of the training split: the classifier's outputs in order. Sorted; those of an
    extension follow the earlier ones."""
    packing: dict[str, Any]
    "The settings that determine its content."
    added: tuple[dict[str, Any], ...] = ()
    "The same settings of each extension, in order."
    rejected: int
    schema_version: int = SCHEMA_VERSION

    def of(self, split: Split | None = None, view: View | None = None) -> list[Shard]:
        """The shards of one split or one view (None: any)."""
        return [
            shard
            for shard in self.shards
            if split in (None, shard.split) and view in (None, shard.view)
        ]


def read_manifest(folder: str) -> Manifest:
    """The manifest of a set of shards.

    Raises InputError when there is none or it cannot be read.
    """
    path = storage.join(folder, MANIFEST)
    if not storage.exists(path):
        raise InputError(
            f"no {MANIFEST} in {folder}: not a finished set of shards; make one with "
            "jobs/make_shards.py"
        )
    try:
        content = json_files.read_checksummed(path)
        if content["schema_version"] != SCHEMA_VERSION:
            raise InputError(
                f"{path} has schema version {content['schema_version']}, expected "
                f"{SCHEMA_VERSION}; pack again"
            )
        manifest = from_json(Manifest, content)
        # A shard's name becomes part of paths, in the set and in everything made from it.
        for shard in manifest.shards:
            if not is_file_name(shard.name) or min(shard.samples, shard.bytes) < 0:
                raise ValueError(
                    f"shard {excerpt(shard.name)} with {shard.samples} samples in "
                    f"{shard.bytes} bytes"
                )
        if len({shard.name for shard in manifest.shards}) < len(manifest.shards):
            raise ValueError("a shard that is listed twice")
        return manifest
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{path} is damaged ({error}), expected the file that packing writes last; put it "
            "back from a copy, or delete it and run jobs/make_shards.py again as it was run, and "
            "after it each --extend"
        ) from None


def write_damaged(folder: str, names: Iterable[str]) -> None:
    """List the damaged shards in DAMAGED_FILE, for packing to repair; without any, remove it."""
    path, listed = storage.join(folder, DAMAGED_FILE), sorted(set(names))
    if listed:
        json_files.write_checksummed(path, {"shards": listed})
    elif storage.exists(path):
        storage.remove(path)


def read_damaged(folder: str) -> frozenset[str]:
    """The shards listed in DAMAGED_FILE; none without that file.

    Raises InputError where it cannot be read.
    """
    path = storage.join(folder, DAMAGED_FILE)
    if not storage.exists(path):
        return frozenset()
    try:
        return frozenset(json_files.read_checksummed(path)["shards"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} is damaged ({error!r}), expected the names of damaged shards; delete it and "
            f"run jobs/make_shards.py --verify --out {folder}"
        ) from None


def repair_hint(folder: str) -> str:
    """The commands that repair damaged shards, for the end of an error message."""
    return (
        f"run jobs/make_shards.py --verify --out {folder} and then the command that packed them "
        "again, which repairs the damaged shards"
    )
