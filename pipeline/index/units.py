"""The units of work of an index: some parts of the table, added to a copy of the trained index; and
many units made into one.

A unit's file is whole or not there, and a file beside it vouches for its bytes; so a killed build
goes on with the units that are missing or damaged. Units are added by one order of rows, and merged
by their number: the index is the same whoever did which and when. Shapes: D dimensions.
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import faiss
import numpy as np

from pipeline.core import json_files, storage
from pipeline.features.table import FeatureTable
from pipeline.index.ids import local_copy
from pipeline.index.metadata import file_checksum
from pipeline.index.part import read_faiss

FAISS: Any = faiss  # whose types know nothing of its keyword arguments


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
    """Numbers of consecutive items in groups of about `wanted` in all: each where its middle lies."""
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
    for block_BD in table.only(unit.table_parts).blocks():
        index.add(block_BD)
    with storage.atomic_file(out) as local:
        FAISS.write_index(index, local)
    write_checksum(out)
    return int(index.ntotal)


def write_checksum(file: str) -> None:
    """Write beside a finished file how many bytes it has, and their hash: without that it is not
    believed later.
    """
    folder, name = file.rsplit("/", 1)
    json_files.write_checksummed(f"{file}.json", file_checksum(folder, name))


def checksum_ok(file: str) -> bool:
    """Whether a file is there and every byte is what was vouched for."""
    folder, name = file.rsplit("/", 1)
    try:
        return storage.exists(f"{file}.json") and json_files.read_checksummed(
            f"{file}.json"
        ) == file_checksum(folder, name)
    except (OSError, ValueError):
        return False


def can_merge(index: Any) -> bool:
    """Whether units of such an index can become one: lists and plain codes can, graphs and refined
    indexes cannot.
    """
    kind = FAISS.downcast_index(
        index
    )  # under another name: it lives only as long as what it is a view of
    if isinstance(kind, FAISS.IndexPreTransform):
        return can_merge(kind.index)
    return isinstance(kind, FAISS.IndexIVF | FAISS.IndexFlatCodes)


def merge_units(trained: str, files: Sequence[str]) -> Any:
    """One index of all units, their rows one after the other. Files are mapped, so no more than the
    result is in memory.
    """
    whole = read_faiss(trained, on_disk=False)
    lists = _lists_of(whole)
    if lists is None:
        shift = 0
        for file in files:
            part = read_faiss(file, on_disk=False)
            rows = part.ntotal
            # Lists keep each row's number, plain codes are numbered by their place.
            whole.merge_from(part, shift if FAISS.try_extract_index_ivf(whole) is not None else 0)
            shift += rows
        return whole
    parts = [read_faiss(file, on_disk=True) for file in files]
    sources = [FAISS.extract_index_ivf(part).invlists for part in parts]
    for number in range(lists.nlist):
        _fill_list(lists, number, list(_pieces(sources, parts, number)))
    ivf = FAISS.extract_index_ivf(whole)
    ivf.ntotal = whole.ntotal = sum(part.ntotal for part in parts)
    return whole


def _lists_of(index: Any) -> Any:
    """The inverted lists, where codes stand in them one by one; None of packed ones and of other
    indexes.
    """
    ivf = FAISS.try_extract_index_ivf(index)
    lists = None if ivf is None else FAISS.downcast_InvertedLists(ivf.invlists)
    return lists if isinstance(lists, FAISS.ArrayInvertedLists) else None


def _pieces(
    sources: Sequence[Any], parts: Sequence[Any], number: int
) -> Iterator[tuple[Any, Any, int]]:
    """A list's row numbers in the whole index, codes and length, unit by unit."""
    shift = 0
    for source, part in zip(sources, parts, strict=True):
        size = source.list_size(number)
        if size:
            ids = FAISS.rev_swig_ptr(source.get_ids(number), size) + shift
            yield ids, source.get_codes(number), size
        shift += part.ntotal


def _fill_list(lists: Any, number: int, pieces: Sequence[tuple[Any, Any, int]]) -> None:
    """Make room for exactly what comes, and copy it: lists that grow take up to twice the memory."""
    lists.resize(number, sum(size for _, _, size in pieces))
    at = 0
    for ids, codes, size in pieces:
        lists.update_entries(
            number, at, size, FAISS.swig_ptr(np.ascontiguousarray(ids, np.int64)), codes
        )
        at += size
