"""A set of shards as its manifest describes it. Packing writes it; training, embedding and the pictures read it.

In: a folder or URI. Out: the Manifest.
"""

from dataclasses import dataclass
from typing import Any

from pipeline import sealed, storage
from pipeline.records import InputError, Split, View

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
        said = sealed.read(path)
        if said["schema_version"] != SCHEMA_VERSION:
            raise InputError(
                f"{path} has schema version {said['schema_version']}, expected {SCHEMA_VERSION}; pack again"
            )
        shard_list = tuple(
            Shard(**shard | {"split": Split(shard["split"]), "view": View(shard["view"])}) for shard in said["shards"]
        )
        return Manifest(
            **said | {"shards": shard_list, "classes": tuple(said["classes"]), "added": tuple(said.get("added", ()))}
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} is damaged ({error}), expected what packing writes last; put it back from a copy, or delete it and run "
            "jobs/make_shards.py again as it was run, and after it each --extend"
        ) from None
