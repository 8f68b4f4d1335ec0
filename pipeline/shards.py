"""A set of shards as its manifest describes it. Packing writes it; training, embedding and the pictures read it.

In: a folder or URI. Out: the Manifest.
"""

from dataclasses import dataclass
from typing import Any

from pipeline import storage
from pipeline.records import InputError, Split, View, excerpt
from pipeline.told import as_told, is_file_name

SCHEMA_VERSION = 1
MANIFEST = "manifest.json"


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
    """What a set of shards holds."""

    shards: tuple[Shard, ...]
    classes: tuple[str, ...]
    "Locations of the training split: the classifier's outputs in order. Sorted; an extension's stand behind those before."
    packing: dict[str, Any]
    "What of the settings decides its content."
    added: tuple[dict[str, Any], ...] = ()
    "The same of each time that it was extended, in order."
    rejected: int
    schema_version: int = SCHEMA_VERSION

    def of(self, split: Split | None = None, view: View | None = None) -> list[Shard]:
        """The shards of one split or one view (None: any)."""
        return [shard for shard in self.shards if split in (None, shard.split) and view in (None, shard.view)]


def read_manifest(shards: str) -> Manifest:
    """The manifest of a set of shards.

    Raises InputError when there is none or it cannot be read.
    """
    path = storage.join(shards, MANIFEST)
    if not storage.exists(path):
        raise InputError(f"no {MANIFEST} in {shards}: not a finished set of shards; make one with jobs/make_shards.py")
    try:
        said = storage.read_json(path)
        if said["schema_version"] != SCHEMA_VERSION:
            raise InputError(
                f"{path} has schema version {said['schema_version']}, expected {SCHEMA_VERSION}; pack again"
            )
        manifest = as_told(Manifest, said)
        for shard in manifest.shards:  # its name becomes that of files, of the set and of what is made of it
            if not is_file_name(shard.name) or not 0 <= shard.samples <= shard.bytes:
                raise ValueError(f"shard {excerpt(shard.name)} with {shard.samples} samples in {shard.bytes} bytes")
        if len({shard.name for shard in manifest.shards}) < len(manifest.shards):
            raise ValueError("a shard that is listed twice")
        return manifest
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path} is damaged ({error}); delete it and run jobs/make_shards.py again") from None
