"""What an index says of itself: `index.json`, written last and replaced whole, so whoever opens one
sees it before or after.

An index has parts, each a FAISS file with the names of its rows. The first is all of a freshly
built index; growing adds others; a removed location stays in its part's file and answers no more.
"""

import hashlib
from dataclasses import asdict, dataclass, field
from typing import Any

from pipeline.core import json_files, storage
from pipeline.core.errors import InputError
from pipeline.core.json_files import from_json, is_file_name
from pipeline.core.records import excerpt
from pipeline.index.plan import Refine

SCHEMA_VERSION = 3
METADATA_FILE = "index.json"
REBUILD_HINT = "delete it and build the index again with jobs/build_index.py"


@dataclass(frozen=True, kw_only=True)
class SearchParams:
    """How hard a search tries: measured against exact search when the index is built."""

    breadth: int
    "nprobe of inverted lists, efSearch of a graph; of no meaning for exact search."
    candidates: int = 1
    "Rows per wanted row that the table's vectors score again; 1: none are."


@dataclass(frozen=True, kw_only=True)
class PartMetadata:
    """One part of an index."""

    faiss: str
    "Name of the FAISS file within the folder."
    ids: str
    "Name of the Arrow file of its rows."
    first_row: int
    "Number of its first row in the whole index; FAISS counts from 0 in each part."
    rows: int
    table_parts: dict[str, str]
    """The feature table's parts that it holds, in order, each with the hash of the shard that was
    embedded."""
    files: dict[str, dict[str, Any]]
    "Of each file its `bytes` and `sha256`."
    removed: tuple[str, ...] = ()
    "Locations that answer no more."


@dataclass(frozen=True, kw_only=True)
class IndexMetadata:
    """A whole index."""

    factory: str
    metric: str
    "Always the inner product: of unit vectors, the cosine."
    rows: int
    "Those of removed locations included."
    dimension: int
    fingerprint: str
    "Of the network that embedded every row."
    table: str
    "Where the feature table was when the index was built."
    asked: dict[str, Any]
    "The settings that decide which rows it holds and how."
    why: str
    "The planner's sentence."
    refine: Refine
    on_disk: bool
    effort: SearchParams
    target_recall: float
    "Of recall@10, which the effort was chosen for."
    unit_rows: int
    "Rows of a unit of work while it was built."
    part_rows: int
    "Rows that a part of it has, about."
    training_sample: int
    "Rows that it was trained on."
    build_seconds: float
    bytes_per_vector: float
    "Of the FAISS files."
    expected_bytes: float | None
    "Memory that the plan reckons with; None for a --factory of the user's."
    measured: dict[str, Any]
    "recall_at_1, recall_at_10, of how many queries from where, queries per second."
    parts: tuple[PartMetadata, ...]
    trained: dict[str, dict[str, Any]]
    "The trained index without rows, which growing copies: name, and its `bytes` and `sha256`."
    schema_version: int = field(default=SCHEMA_VERSION)

    @property
    def files(self) -> tuple[dict[str, dict[str, Any]], ...]:
        """The files of the trained index, and of each part."""
        return self.trained, *(part.files for part in self.parts)

    @property
    def table_parts(self) -> dict[str, str]:
        """All parts of the table that it holds, in the order of its rows, each with its shard's
        hash.
        """
        return {name: shard for part in self.parts for name, shard in part.table_parts.items()}


def metadata_dict(facts: IndexMetadata) -> dict[str, Any]:
    """The facts as `index.json` has them: what was measured beside the rest."""
    said = asdict(facts)
    measured: dict[str, Any] = said.pop("measured")
    return said | measured


def write_metadata(folder: str, facts: IndexMetadata) -> None:
    json_files.write_checksummed(storage.join(folder, METADATA_FILE), metadata_dict(facts))


def read_metadata(folder: str) -> IndexMetadata:
    """What the index in a folder says of itself.

    Raises InputError when there is none, or it was written by another version.
    """
    path = storage.join(folder, METADATA_FILE)
    if not storage.exists(path):
        raise InputError(
            f"no index at {folder}: found no {METADATA_FILE}; make one with jobs/build_index.py"
        )
    try:
        said = json_files.read_checksummed(path)
        if said["schema_version"] != SCHEMA_VERSION:
            raise InputError(
                f"{path} is of version {said['schema_version']}, expected {SCHEMA_VERSION}; {REBUILD_HINT}"
            )
        own = {
            name: said.pop(name)
            for name in IndexMetadata.__dataclass_fields__
            if name != "measured"
        }
        facts = from_json(IndexMetadata, {**own, "measured": said})
        listed = (name for files in facts.files for name in files)
        named = [
            *listed,
            *facts.table_parts,
            *(name for part in facts.parts for name in (part.faiss, part.ids)),
        ]
        if strange := next((name for name in named if not is_file_name(name)), None):
            raise ValueError(f"a file called {excerpt(strange)}")
        effort = facts.effort
        if (
            min(
                facts.rows,
                facts.dimension,
                effort.breadth,
                effort.candidates,
                facts.unit_rows,
                facts.part_rows,
            )
            < 1
        ):
            raise ValueError("a count below 1")
        if not all(
            {"bytes", "sha256"} <= file.keys() for files in facts.files for file in files.values()
        ):
            raise ValueError("a file without size or hash")
        return facts
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(
            f"{path} is damaged ({error!r}), expected what build_index writes; {REBUILD_HINT}"
        ) from None


def file_checksum(folder: str, name: str) -> dict[str, Any]:
    """Size and hash of a file of the index."""
    digest, size = hashlib.sha256(), 0
    with storage.open_read(storage.join(folder, name)) as stream:
        while piece := stream.read(1 << 22):
            digest.update(piece)
            size += len(piece)
    return {"bytes": size, "sha256": digest.hexdigest()}


def check_files(folder: str, files: dict[str, dict[str, Any]], whole: bool = False) -> None:
    """Raise InputError where a file of an index is gone or has another size or, looked at `whole`,
    other content.
    """
    for name, expected in files.items():
        path = storage.join(folder, name)
        found = storage.size(path) if storage.exists(path) else None
        if found != expected["bytes"]:
            seen = "is not there" if found is None else f"has {found:,} bytes"
            raise InputError(
                f"{path} {seen}, expected {expected['bytes']:,} bytes; the index is damaged; {REBUILD_HINT}"
            )
        if whole and file_checksum(folder, name) != expected:
            raise InputError(
                f"{path} holds other bytes than were written; the index is damaged; {REBUILD_HINT}"
            )
