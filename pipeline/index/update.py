"""Changes of a finished index: new parts of its table are added, locations removed, bytes verified.

Nothing is built again: extending adds parts to the index, removing notes the locations in
`index.json`.
"""

import os
import tempfile
import time
from collections.abc import Iterable
from dataclasses import asdict, replace

import numpy as np

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.filters import Filter
from pipeline.core.lock import locks_output
from pipeline.core.progress import console
from pipeline.core.records import Split, View
from pipeline.features.table import FeatureTable, open_table
from pipeline.index.balance import list_lengths, lost_balance
from pipeline.index.faiss_io import FAISS, local_copy
from pipeline.index.finish import finish_index
from pipeline.index.ids import RowIds
from pipeline.index.metadata import (
    IndexMetadata,
    PartMetadata,
    check_files,
    read_metadata,
    write_metadata,
)
from pipeline.index.searcher import Index
from pipeline.index.tuning.ground_truth import sample_queries
from pipeline.index.workspace import BuildWorkspace, rows_by_part


@locks_output(lambda table, out, workers=0: out)
def extend_index(table: str, out: str, workers: int = 0) -> IndexMetadata:
    """Add the rows of those parts of a table that an index does not hold yet; without any the index
    is not touched.

    Raises InputError when the table is of another encoder, or no longer holds what the index was
    built from.
    """
    start = time.perf_counter()
    metadata, whole_table = read_metadata(out), open_table(table)
    split, view = metadata.settings["split"], metadata.settings["view"]
    selected = whole_table.select(Split(split) if split else None, View(view) if view else None)
    _check_same_table(out, metadata, selected)
    indexed = metadata.table_parts
    missing = selected.with_parts([name for name in selected.parts if name not in indexed])
    added = rows_by_part(missing)
    if not added:
        console.print(f"{out} holds all of {table}: {metadata.rows} rows; nothing to do")
        return metadata
    FAISS.omp_set_num_threads(os.cpu_count() or 1)  # Ray sets OMP_NUM_THREADS in its jobs
    check_files(out, metadata.trained, content=True)
    identity = {"extends": [asdict(part) for part in metadata.parts], "by": missing.digest}
    workspace = BuildWorkspace(out, selected, identity, workers)
    workspace.reuse_trained()
    parts = workspace.build(
        added, metadata.unit_rows, metadata.part_rows, metadata.rows, len(metadata.parts)
    )
    metadata = replace(
        metadata,
        rows=metadata.rows + sum(added.values()),
        parts=metadata.parts + parts,
        table=storage.absolute(whole_table.path),
    )
    in_order = selected.with_parts([*indexed, *added])  # the order of the index's rows
    others = whole_table.select(Split.QUERY) if split == Split.GALLERY else None
    queries = sample_queries(in_order, rows_by_part(in_order), others)
    earlier = metadata.measured.get("recall_at_10")
    metadata = finish_index(out, metadata, queries, workspace, start)
    if earlier is not None:
        console.print(
            f"{out}: recall@10 was {earlier:.3f} before the extension and is "
            f"{metadata.measured['recall_at_10']:.3f} now, measured again"
        )
    opened = Index(out).parts
    lengths_L, before_L = list_lengths(opened), list_lengths(opened[: -len(parts)])
    if lengths_L is None or before_L is None:
        return metadata
    if sentence := lost_balance(before_L, lengths_L):
        console.print(f"{out}: {sentence}", style="yellow")
    return metadata


@locks_output(lambda out, locations: out)
def remove_locations(out: str, locations: Iterable[str]) -> IndexMetadata:
    """Filter locations out of every search of an index. Their vectors stay in its files until it is
    built again.

    Raises InputError, and removes none, when the index does not hold one of them.
    """
    metadata, wanted = read_metadata(out), frozenset(locations)
    with tempfile.TemporaryDirectory() as scratch:
        marked = [_mark_removed(out, part, wanted, scratch) for part in metadata.parts]
    parts = tuple(part for part, _ in marked)
    removed = {
        name
        for part, before in zip(parts, metadata.parts, strict=True)
        for name in set(part.removed) - {*before.removed}
    }
    if unknown := sorted(wanted - removed):
        raise InputError(
            f"{out} has no rows of {len(unknown)} of the locations to remove, such as "
            f"{unknown[0]}; nothing was removed; check their names in its ids.parquet"
        )
    metadata = replace(metadata, parts=parts)
    write_metadata(out, metadata)
    left = sum(rows for _, rows in marked)
    console.print(
        f"{out}: {len(removed)} locations removed, {left:,} of {metadata.rows:,} rows are left"
    )
    return metadata


def verify_index(out: str) -> IndexMetadata:
    """Compare every byte of an index with its checksums.

    Raises InputError where one differs.
    """
    metadata = read_metadata(out)
    check_files(out, metadata.trained, content=True)
    Index(out, verify=True)
    console.print(
        f"{out}: {metadata.rows:,} rows in {len(metadata.parts)} parts, every byte as it was "
        "written"
    )
    return metadata


def _mark_removed(
    out: str, part: PartMetadata, locations: frozenset[str], scratch: str
) -> tuple[PartMetadata, int]:
    """The part with those of the locations that it holds among the removed ones, and how many of
    its rows are left.
    """
    check_files(out, part.files)
    ids = RowIds(local_copy(storage.join(out, part.ids), scratch))
    row_R = np.flatnonzero(ids.mask(Filter(locations=locations)))
    present = set(ids.take(row_R, ["location"])["location"].to_pylist())
    removed = tuple(sorted({*part.removed, *present}))
    gone = int(np.count_nonzero(ids.mask(Filter(locations=frozenset(removed)))))
    return replace(part, removed=removed), part.rows - gone


def _check_same_table(out: str, metadata: IndexMetadata, table: FeatureTable) -> None:
    """Raise InputError where a table is not the one that the index was built from, with more."""
    if metadata.fingerprint != table.fingerprint:
        raise InputError(
            f"{out} is of network {metadata.fingerprint[:12]} and {table.path} of "
            f"{table.fingerprint[:12]}; expected one; embed with the index's network "
            "(jobs/embed_gallery.py --checkpoint), or build another index"
        )
    indexed, current = metadata.table_parts, table.shards
    changed = sorted(name for name, shard in indexed.items() if current.get(name) != shard)
    if changed:
        raise InputError(
            f"{table.path} no longer holds {len(changed)} of the {len(indexed)} parts that {out} "
            f"was built from, such as {changed[0]}; expected the same and more; build the index "
            "again"
        )
