"""The metadata of an index: `index.json`, written last and replaced atomically, so a reader sees
the index before a change or after it.

An index has parts, each a FAISS file with the ids of its rows. A freshly built index has one or
several; extending it adds others; a removed location stays in its part's file and is filtered out
of every search.
"""

from dataclasses import asdict, dataclass, field
from typing import Any

from pipeline.core import json_files, storage
from pipeline.core.errors import InputError
from pipeline.core.integrity import FileChecksum, find_mismatch
from pipeline.core.json_files import from_json, is_file_name
from pipeline.core.records import excerpt
from pipeline.features.encoding import EncodingConfig
from pipeline.index.planning.families import Refine
from pipeline.index.planning.plan import RERANK_FACTOR

SCHEMA_VERSION = 3
METADATA_FILE = "index.json"
REBUILD_HINT = "delete it and build the index again with jobs/build_index.py"


@dataclass(frozen=True, kw_only=True)
class SearchParams:
    """How thorough a search is: chosen by comparison with exact search when the index is built."""

    nprobe_or_ef: int
    "nprobe of inverted lists, efSearch of a graph; without effect on exact search."
    rerank_factor: int = 1
    "Candidates per wanted row whose scores the table's vectors compute anew; 1: none."
    list_ratio: float = 0.0
    """Lists whose centre scores below this share of the query's best centre are skipped; 0:
    none."""
    hidden_nprobe_or_ef: int | None = None
    """nprobe or efSearch for queries whose nearest row a filter hides, where it leaves half of the
    rows; None: not chosen."""
    hidden_rerank_factor: int = RERANK_FACTOR
    "Their candidates per wanted row, if there are candidates."


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
    files: dict[str, FileChecksum]
    removed: tuple[str, ...] = ()
    "Locations that searches no longer return."


@dataclass(frozen=True, kw_only=True)
class IndexMetadata:
    """A whole index."""

    factory: str
    metric: str
    "Always the inner product: for unit vectors, the cosine."
    rows: int
    "Those of removed locations included."
    dimension: int
    fingerprint: str
    "Of the encoder that embedded every row."
    encoding: EncodingConfig | None
    "How it encoded the images, and photos must be; None for features of another program."
    table: str
    "Where the feature table was when the index was built."
    settings: dict[str, Any]
    "Those that decide which rows it holds and how."
    reason: str
    "The planner's sentence."
    refine: Refine
    on_disk: bool
    search_params: SearchParams
    target_recall: float
    "Recall@10 for which the search parameters were chosen."
    unit_rows: int
    "Rows of a work unit while it was built."
    part_rows: int
    "Rows per part of the index, about."
    training_sample: int
    "Rows that it was trained on."
    build_seconds: float
    bytes_per_vector: float
    "Of the FAISS files."
    expected_bytes: float | None
    "Memory that the plan expected; None for a --factory of the user's."
    measured: dict[str, Any]
    "recall_at_1, recall_at_10, from how many queries of which source, queries per second."
    parts: tuple[PartMetadata, ...]
    trained: dict[str, FileChecksum]
    "The file of the trained index without rows, which extending copies."
    schema_version: int = field(default=SCHEMA_VERSION)

    @property
    def files(self) -> tuple[dict[str, FileChecksum], ...]:
        """The files of the trained index, and of each part."""
        return self.trained, *(part.files for part in self.parts)

    @property
    def table_parts(self) -> dict[str, str]:
        """All parts of the table that it holds, in the order of its rows, each with its shard's
        hash.
        """
        return {name: shard for part in self.parts for name, shard in part.table_parts.items()}


def metadata_dict(metadata: IndexMetadata) -> dict[str, Any]:
    """The metadata as `index.json` has them: the measured figures beside the other fields."""
    entries = asdict(metadata)
    measured: dict[str, Any] = entries.pop("measured")
    return entries | measured


def write_metadata(folder: str, metadata: IndexMetadata) -> None:
    json_files.write_checksummed(storage.join(folder, METADATA_FILE), metadata_dict(metadata))


def read_metadata(folder: str) -> IndexMetadata:
    """The metadata of the index in a folder.

    Raises InputError when there is none, or another schema version wrote it.
    """
    path = storage.join(folder, METADATA_FILE)
    if not storage.exists(path):
        raise InputError(
            f"no index at {folder}: found no {METADATA_FILE}; make one with jobs/build_index.py"
        )
    try:
        entries = json_files.read_checksummed(path)
        if entries["schema_version"] != SCHEMA_VERSION:
            raise InputError(
                f"{path} is of version {entries['schema_version']}, expected {SCHEMA_VERSION}; "
                f"{REBUILD_HINT}"
            )
        fields = IndexMetadata.__dataclass_fields__
        own = {name: entries.pop(name) for name in fields if name != "measured"}
        metadata = from_json(IndexMetadata, {**own, "measured": entries})
        _check(metadata)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(
            f"{path} is damaged ({error!r}), expected what build_index writes; {REBUILD_HINT}"
        ) from None
    return metadata


def _check(metadata: IndexMetadata) -> None:
    """Raise ValueError where a file name leads out of the folder or a figure is impossible."""
    names = [name for files in metadata.files for name in files]
    names += metadata.table_parts
    names += [name for part in metadata.parts for name in (part.faiss, part.ids)]
    if invalid := next((name for name in names if not is_file_name(name)), None):
        raise ValueError(f"a file called {excerpt(invalid)}")
    params = metadata.search_params
    counts = (metadata.rows, metadata.dimension, metadata.unit_rows, metadata.part_rows)
    if min(*counts, params.nprobe_or_ef, params.rerank_factor) < 1:
        raise ValueError("a count below 1")


def check_files(folder: str, files: dict[str, FileChecksum], content: bool = False) -> None:
    """Raise InputError where a file of an index is missing or has another size; with `content` also
    where its SHA-256 differs.
    """
    for name, expected in files.items():
        path = storage.join(folder, name)
        if mismatch := find_mismatch(path, expected, content):
            raise InputError(f"{path} {mismatch}; the index is damaged; {REBUILD_HINT}")
