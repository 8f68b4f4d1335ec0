"""Work units of an index build: parts of the table, added to a copy of the trained index, and the
merging of units into one index.

A unit's file appears atomically, with its checksum beside it, so a killed build resumes with the
units that are missing or damaged. Rows are added in one order and units merged by their number: the
index is the same whichever worker built a unit, and when.
Shapes: D dimensions, L rows of an inverted list.
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.core import storage
from pipeline.core.integrity import write_checksum
from pipeline.features.table import FeatureTable
from pipeline.index.faiss_io import FAISS, local_copy, read_faiss


@dataclass(frozen=True, kw_only=True)
class WorkUnit:
    """Consecutive parts of the table."""

    table_parts: tuple[str, ...]
    rows: int


def plan_units(rows_of_part: dict[str, int], rows: int) -> list[WorkUnit]:
    """The table's parts in their order, in units of about so many rows."""
    names = list(rows_of_part)
    groups = even_groups(list(rows_of_part.values()), rows)
    return [
        WorkUnit(
            table_parts=tuple(names[i] for i in group),
            rows=sum(rows_of_part[names[i]] for i in group),
        )
        for group in groups
    ]


def even_groups(sizes: Sequence[int], wanted: int) -> list[list[int]]:
    """Numbers of consecutive items in groups of about `wanted` in all: each goes where its middle
    lies.
    """
    groups: dict[int, list[int]] = {}
    begin = 0
    for number, size in enumerate(sizes):
        groups.setdefault((2 * begin + size) // (2 * wanted), []).append(number)
        begin += size
    return list(groups.values())


def build_unit(trained: str, table: FeatureTable, unit: WorkUnit, out: str, threads: int) -> int:
    """Add a unit's rows to a copy of the trained index and write it to `out`. Returns its rows."""
    FAISS.omp_set_num_threads(threads)
    with tempfile.TemporaryDirectory() as scratch:
        index = read_faiss(local_copy(trained, scratch), on_disk=False)
    for block_BD in table.with_parts(unit.table_parts).blocks():
        index.add(block_BD)
    with storage.atomic_file(out) as local:
        FAISS.write_index(index, local)
    write_checksum(out)
    return int(index.ntotal)


def can_merge(index: Any) -> bool:
    """Whether units of such an index can be merged: lists and plain codes can, graphs and refined
    indexes cannot.
    """
    # A name of its own: `index` must outlive the view that downcasting returns.
    kind = FAISS.downcast_index(index)
    if isinstance(kind, FAISS.IndexPreTransform):
        return can_merge(kind.index)
    return isinstance(kind, FAISS.IndexIVF | FAISS.IndexFlatCodes)


def merge_units(trained: str, files: Sequence[str]) -> Any:
    """One index of all units, their rows one after the other. Files are mapped, so only the result
    is in memory.
    """
    merged = read_faiss(trained, on_disk=False)
    lists = _plain_lists(merged)
    if lists is None:
        shift = 0
        for file in files:
            unit = read_faiss(file, on_disk=False)
            rows = unit.ntotal
            # Lists hold each row's number, plain codes are numbered by their position.
            has_lists = FAISS.try_extract_index_ivf(merged) is not None
            merged.merge_from(unit, shift if has_lists else 0)
            shift += rows
        return merged
    units = [read_faiss(file, on_disk=True) for file in files]
    sources = [FAISS.extract_index_ivf(unit).invlists for unit in units]
    for number in range(lists.nlist):
        _fill_list(lists, number, list(_pieces(sources, units, number)))
    ivf = FAISS.extract_index_ivf(merged)
    ivf.ntotal = merged.ntotal = sum(unit.ntotal for unit in units)
    return merged


def _plain_lists(index: Any) -> Any:
    """The inverted lists, where they hold codes one by one; None of packed ones and of other
    indexes.
    """
    ivf = FAISS.try_extract_index_ivf(index)
    lists = None if ivf is None else FAISS.downcast_InvertedLists(ivf.invlists)
    return lists if isinstance(lists, FAISS.ArrayInvertedLists) else None


def _pieces(
    sources: Sequence[Any], units: Sequence[Any], number: int
) -> Iterator[tuple[Any, Any, int]]:
    """A list's row numbers in the merged index, its codes and its length, unit by unit."""
    shift = 0
    for source, unit in zip(sources, units, strict=True):
        size = source.list_size(number)
        if size:
            row_L = FAISS.rev_swig_ptr(source.get_ids(number), size) + shift
            yield row_L, source.get_codes(number), size
        shift += unit.ntotal


def _fill_list(lists: Any, number: int, pieces: Sequence[tuple[Any, Any, int]]) -> None:
    """Reserve exactly the space of the pieces, and copy them: lists that grow take up to twice the
    memory.
    """
    lists.resize(number, sum(size for _, _, size in pieces))
    at = 0
    for row_L, codes, size in pieces:
        rows = FAISS.swig_ptr(np.ascontiguousarray(row_L, np.int64))
        lists.update_entries(number, at, size, rows, codes)
        at += size
