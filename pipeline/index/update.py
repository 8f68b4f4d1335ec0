"""A finished index that changes: new parts of its table come in, locations go out, every byte is
looked at.

What was there is not built again: growing adds parts to the index, removing notes the locations in
`index.json`.
"""

import os
import tempfile
import time
from collections.abc import Iterable
from dataclasses import asdict, replace
from typing import Any

import faiss
import numpy as np

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.lock import locks_output
from pipeline.core.progress import console
from pipeline.core.records import Split, View
from pipeline.features.table import FeatureTable, open_table
from pipeline.index.build import finish_index
from pipeline.index.filters import Filter
from pipeline.index.ids import RowIds, local_copy
from pipeline.index.metadata import (
    IndexMetadata,
    PartMetadata,
    check_files,
    metadata_dict,
    read_metadata,
    write_metadata,
)
from pipeline.index.recall import sample_queries
from pipeline.index.searcher import Index
from pipeline.index.workspace import BuildWorkspace, rows_by_part


@locks_output(lambda table, out, workers=0: out)
def extend_index(table: str, out: str, workers: int = 0) -> dict[str, Any]:
    """Add the rows of those parts of a table that an index does not hold yet; with none it is left
    as it is.

    Raises InputError when the table is of another network, or no longer holds what the index was
    built from.
    """
    start = time.perf_counter()
    told, whole = read_metadata(out), open_table(table)
    split, view = told.asked["split"], told.asked["view"]
    chosen = whole.select(Split(split) if split else None, View(view) if view else None)
    _check_same_table(out, told, chosen)
    held = told.table_parts
    missing = [name for name in chosen.parts if name not in held]
    added = rows_by_part(chosen.only(missing))
    if not added:
        console.print(f"{out} holds all of {table}: {told.rows} rows; nothing to do")
        return metadata_dict(told)
    faiss.omp_set_num_threads(
        os.cpu_count() or 1
    )  # Ray sets OMP_NUM_THREADS in its jobs; this one uses all cores
    check_files(out, told.trained, whole=True)
    identity = {"extends": [asdict(part) for part in told.parts], "by": chosen.only(missing).digest}
    workshop = BuildWorkspace(out=out, table=chosen, identity=identity, workers=workers)
    workshop.reuse_trained()
    parts = workshop.build(added, told.unit_rows, told.part_rows, told.rows, len(told.parts))
    facts = replace(
        told,
        rows=told.rows + sum(added.values()),
        parts=told.parts + parts,
        table=storage.absolute(whole.path),
    )
    now = chosen.only([*held, *added])  # the order of the index's rows
    others = whole.select(Split.QUERY) if split == Split.GALLERY else None
    return finish_index(out, facts, sample_queries(now, rows_by_part(now), others), workshop, start)


@locks_output(lambda out, locations: out)
def remove_locations(out: str, locations: Iterable[str]) -> dict[str, Any]:
    """Make locations of an index answer no more. Their vectors stay in its files until it is built
    again.

    Raises InputError, and removes none, when one of them is not there.
    """
    told, wanted = read_metadata(out), frozenset(locations)
    with tempfile.TemporaryDirectory() as scratch:
        thinned = [_mark_removed(out, part, wanted, scratch) for part in told.parts]
    parts = tuple(part for part, _ in thinned)
    gone = {
        name
        for part, before in zip(parts, told.parts, strict=True)
        for name in set(part.removed) - {*before.removed}
    }
    unknown = sorted(wanted - gone)
    if unknown:
        raise InputError(
            f"{out} has no rows of {len(unknown)} of the locations to remove, such as {unknown[0]}; nothing was removed; check "
            "their names in its ids.parquet"
        )
    facts = replace(told, parts=parts)
    write_metadata(out, facts)
    left = sum(answering for _, answering in thinned)
    console.print(f"{out}: {len(gone)} locations removed, {left:,} of {told.rows:,} rows answer")
    return metadata_dict(facts)


def verify_index(out: str) -> IndexMetadata:
    """Look at every byte of an index.

    Raises InputError where one is not what was written.
    """
    told = read_metadata(out)
    check_files(out, told.trained, whole=True)
    Index(out, whole=True)
    console.print(
        f"{out}: {told.rows:,} rows in {len(told.parts)} parts, every byte as it was written"
    )
    return told


def _mark_removed(
    out: str, part: PartMetadata, locations: frozenset[str], scratch: str
) -> tuple[PartMetadata, int]:
    """The part with those of the locations that it holds among the removed ones, and how many of
    its rows answer then.
    """
    check_files(out, part.files)
    ids = RowIds(local_copy(storage.join(out, part.ids), scratch))
    rows = np.flatnonzero(ids.mask(Filter(locations=locations)))
    found = set(ids.take(rows, ["location"])["location"].to_pylist())
    thinned = replace(part, removed=tuple(sorted({*part.removed, *found})))
    return thinned, part.rows - int(
        np.count_nonzero(ids.mask(Filter(locations=frozenset(thinned.removed))))
    )


def _check_same_table(out: str, told: IndexMetadata, table: FeatureTable) -> None:
    """Raise InputError where a table is not the one that the index was built from, with more."""
    if told.fingerprint != table.fingerprint:
        raise InputError(
            f"{out} is of network {told.fingerprint[:12]} and {table.path} of {table.fingerprint[:12]}; expected one; embed "
            "with the index's network (jobs/embed_gallery.py --checkpoint), or build another index"
        )
    held, now = told.table_parts, table.shards
    changed = sorted(name for name, shard in held.items() if now.get(name) != shard)
    if changed:
        raise InputError(
            f"{table.path} no longer holds {len(changed)} of the {len(held)} parts that {out} was built from, such as "
            f"{changed[0]}; expected the same and more; build the index again"
        )
