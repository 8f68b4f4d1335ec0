"""A set of shards as its manifest describes it. Packing writes it; training, embedding and the
pictures read it.

In: a folder or URI. Out: the Manifest.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any

from pipeline.core import json_files, storage
from pipeline.core.errors import InputError
from pipeline.core.json_files import from_json, is_file_name
from pipeline.core.records import Split, View, excerpt

SCHEMA_VERSION = 2
MANIFEST = "manifest.json"
DAMAGED_FILE = "damaged.json"
"""Names of the shards that verification found damaged: packing makes them anew, and takes the note
away."""


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
    """Locations of the training split: the classifier's outputs in order. Sorted; an extension's
    stand behind those before."""
    packing: dict[str, Any]
    "What of the settings decides its content."
    added: tuple[dict[str, Any], ...] = ()
    "The same of each time that it was extended, in order."
    rejected: int
    schema_version: int = SCHEMA_VERSION

    def of(self, split: Split | None = None, view: View | None = None) -> list[Shard]:
        """The shards of one split or one view (None: any)."""
        return [
            shard
            for shard in self.shards
            if split in (None, shard.split) and view in (None, shard.view)
        ]


def read_manifest(shards: str) -> Manifest:
    """The manifest of a set of shards.

    Raises InputError when there is none or it cannot be read.
    """
    path = storage.join(shards, MANIFEST)
    if not storage.exists(path):
        raise InputError(
            f"no {MANIFEST} in {shards}: not a finished set of shards; make one with jobs/make_shards.py"
        )
    try:
        said = json_files.read_checksummed(path)
        if said["schema_version"] != SCHEMA_VERSION:
            raise InputError(
                f"{path} has schema version {said['schema_version']}, expected {SCHEMA_VERSION}; pack again"
            )
        manifest = from_json(Manifest, said)
        for shard in (
            manifest.shards
        ):  # its name becomes that of files, of the set and of what is made of it
            if not is_file_name(shard.name) or min(shard.samples, shard.bytes) < 0:
                raise ValueError(
                    f"shard {excerpt(shard.name)} with {shard.samples} samples in {shard.bytes} bytes"
                )
        if len({shard.name for shard in manifest.shards}) < len(manifest.shards):
            raise ValueError("a shard that is listed twice")
        return manifest
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{path} is damaged ({error}), expected what packing writes last; put it back from a copy, or delete it and run "
            "jobs/make_shards.py again as it was run, and after it each --extend"
        ) from None


def write_damaged(shards: str, names: Iterable[str]) -> None:
    """Leave a note of the shards that are damaged, for packing; with none, take it away."""
    path, listed = storage.join(shards, DAMAGED_FILE), sorted(set(names))
    if listed:
        json_files.write_checksummed(path, {"shards": listed})
    elif storage.exists(path):
        storage.remove(path)


def read_damaged(shards: str) -> frozenset[str]:
    """The shards that the note names; none where there is no note.

    Raises InputError where it cannot be read.
    """
    path = storage.join(shards, DAMAGED_FILE)
    try:
        return (
            frozenset(json_files.read_checksummed(path)["shards"])
            if storage.exists(path)
            else frozenset()
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} is damaged ({error!r}), expected the names of damaged shards; delete it and run jobs/make_shards.py "
            f"--verify --out {shards}"
        ) from None


def missing_tars(shards: str, described: Iterable[Shard]) -> dict[str, str]:
    """By name, what is wrong with the tars that are not there or have another size than the
    manifest says. One listing.
    """
    sizes, wrong = storage.walk(shards), dict[str, str]()
    for shard in described:
        path, size = storage.join(shards, f"{shard.name}.tar"), sizes.get(f"{shard.name}.tar")
        if size is None:
            wrong[shard.name] = f"{path} is missing"
        elif size != shard.bytes:
            wrong[shard.name] = f"{path} has {size} bytes, the manifest says {shard.bytes}"
    return wrong


def require_tars(shards: str, described: Iterable[Shard]) -> None:
    """Raise InputError where tars are not there or have another size than the manifest says."""
    if wrong := missing_tars(shards, described):
        raise InputError(
            f"{len(wrong)} shards cannot be used: {first_three(wrong.values())}; {repair_hint(shards)}"
        )


def repair_hint(shards: str) -> str:
    """What to do about damaged shards."""
    return (
        f"run jobs/make_shards.py --verify --out {shards} and then the command that packed them again, which makes anew what "
        "is damaged"
    )


def first_three(sentences: Collection[str]) -> str:
    """The first three."""
    told = list(sentences)
    return "; ".join(told[:3]) + (f"; and {len(told) - 3} more" if len(told) > 3 else "")
