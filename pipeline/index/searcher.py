"""An index on disk, opened for searching: the parts are searched, what they find is merged, and
rows become places.

Built by pipeline/index/build.py, grown by pipeline/index/update.py, spread over a cluster by
pipeline/index/distributed.py. Shapes: Q queries, K rows wanted, D dimensions.
"""

import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import faiss
import numpy as np
import pyarrow as pa

from pipeline.core.arrays import Ints
from pipeline.core.errors import InputError
from pipeline.core.records import View
from pipeline.features.row_reader import RowReader, supports_row_reads
from pipeline.features.table import Floats
from pipeline.index.filters import Filter
from pipeline.index.metadata import IndexMetadata, SearchParams, metadata_dict, read_metadata
from pipeline.index.part import NO_ROW, IndexPart

HASHED_ON_OPEN_BYTES = 1 << 30
"Bytes of an index up to which opening it hashes them: a second, about."


@dataclass(frozen=True, kw_only=True)
class Hit:
    """One row that a search found."""

    key: str
    "Key of the gallery image."
    location: str
    "The location that it shows."
    view: View
    "Where it was taken from."
    lat: float | None
    "Degrees north; null where the position is not known."
    lon: float | None
    "Degrees east."
    score: float
    "Cosine similarity, -1 to 1; by compressed vectors where the index keeps these only."


class Searchable(Protocol):
    """What answers queries: an index of this process, or one that is spread over a cluster."""

    facts: dict[str, Any]
    dimension: int

    def __len__(self) -> int: ...

    def search(
        self, queries_QD: Floats, k: int = 10, where: Filter | None = None
    ) -> list[list[Hit]]: ...


class Index:
    """An index on disk, opened for searching. Not for several threads at once: FAISS spreads a
    search over the cores itself.
    """

    def __init__(
        self,
        path: str,
        parts: Sequence[int] | None = None,
        threads: int | None = None,
        told: IndexMetadata | None = None,
        whole: bool | None = None,
    ) -> None:
        """`parts`: numbers of those to open; all by default. `threads`: of FAISS; by default one
        per core. `told`: what index.json says, where it is not written yet. `whole`: whether every
        byte is looked at, by default of small parts.

        Raises InputError when there is no index at `path`, or it is damaged.
        """
        self.path, self.told = path, told or read_metadata(path)
        self.facts = metadata_dict(self.told)
        self.dimension = self.told.dimension
        # Ray sets OMP_NUM_THREADS to a task's cores before FAISS is loaded, and in its jobs that is
        # one.
        faiss.omp_set_num_threads(threads or os.cpu_count() or 1)
        with (
            tempfile.TemporaryDirectory() as scratch
        ):  # what is mapped of it lives on without its name
            self._parts = list(open_parts(path, self.told, scratch, parts, whole))

    def __len__(self) -> int:
        """Rows that may answer."""
        removed = sum(
            int(np.count_nonzero(~mask))
            for part in self._parts
            if (mask := part.allowed(None)) is not None
        )
        return sum(part.facts.rows for part in self._parts) - removed

    def search(
        self,
        queries_QD: Floats,
        k: int = 10,
        where: Filter | None = None,
        effort: SearchParams | None = None,
    ) -> list[list[Hit]]:
        """The K best rows of each query that may answer, best first; fewer where fewer may.

        `effort`: how hard to try, by default what the index was measured with. Raises InputError when the queries have
        another dimension.
        """
        scores_QK, rows_QK = self.search_rows(queries_QD, k, where, effort)
        return make_hits(scores_QK, rows_QK, self.names(rows_QK))

    def search_rows(
        self,
        queries_QD: Floats,
        k: int = 10,
        where: Filter | None = None,
        effort: SearchParams | None = None,
    ) -> tuple[Floats, Ints]:
        """Scores and row numbers (Q, K) of the whole index, best first; NOBODY where fewer rows may
        answer.
        """
        queries_QD = np.ascontiguousarray(queries_QD, np.float32)
        if queries_QD.ndim != 2 or queries_QD.shape[1] != self.dimension:
            raise InputError(
                f"the queries have the shape {queries_QD.shape}, expected (queries, {self.dimension}); embed them with the "
                "network of the index"
            )
        found = []
        for part in self._parts:
            scores_QK, rows_QK = part.search(queries_QD, k, effort or self.told.effort, where)
            found.append(
                (scores_QK, np.where(rows_QK == NO_ROW, NO_ROW, rows_QK + part.facts.first_row))
            )
        return merge_results(found, k)

    def names(self, rows_QK: Ints) -> pa.Table:
        """What is known of the rows found, in their order, NOBODY left out."""
        rows = rows_QK[rows_QK != NO_ROW]
        order: list[Ints] = []
        tables = []
        for part in self._parts:
            here = np.flatnonzero(
                (rows >= part.facts.first_row) & (rows < part.facts.first_row + part.facts.rows)
            )
            order.append(here)
            tables.append(part.ids.take(rows[here] - part.facts.first_row))
        back = np.empty(len(rows), np.int64)
        back[np.concatenate([np.empty(0, np.int64), *order])] = np.arange(len(rows))
        return pa.concat_tables(tables).take(pa.array(back))


def open_parts(
    path: str,
    told: IndexMetadata,
    scratch: str,
    parts: Sequence[int] | None = None,
    whole: bool | None = None,
) -> Iterator[IndexPart]:
    """The parts of an index, opened. By default every byte is looked at where they are small: FAISS
    may end the process over a damaged file."""
    reader = RowReader(told.table, told.dimension) if supports_row_reads(told.table) else None
    wanted = [facts for number, facts in enumerate(told.parts) if parts is None or number in parts]
    if whole is None:
        whole = (
            sum(file["bytes"] for facts in wanted for file in facts.files.values())
            <= HASHED_ON_OPEN_BYTES
        )
    for facts in wanted:
        yield IndexPart(path, facts, reader, told.on_disk, scratch, whole)


def merge_results(found: Sequence[tuple[Floats, Ints]], k: int) -> tuple[Floats, Ints]:
    """The K best of what several parts found: higher scores first, at equal scores the lower row,
    NOBODY last.
    """
    scores_QM = np.concatenate([scores for scores, _ in found], axis=1)
    rows_QM = np.concatenate([rows for _, rows in found], axis=1)
    order_QK = np.lexsort(
        (np.where(rows_QM == NO_ROW, np.iinfo(np.int64).max, rows_QM), -scores_QM), axis=1
    )[:, :k]
    return np.take_along_axis(scores_QM, order_QK, 1), np.take_along_axis(rows_QM, order_QK, 1)


def make_hits(scores_QK: Floats, rows_QK: Ints, names: pa.Table) -> list[list[Hit]]:
    """Hits of each query from what `search_rows` and `names` give."""
    said, found, begin = names.to_pylist(), [], 0
    for scores_K, count in zip(
        scores_QK, np.count_nonzero(rows_QK != NO_ROW, axis=1).tolist(), strict=True
    ):
        rows = zip(said[begin : begin + count], scores_K[:count].tolist(), strict=True)
        found.append(
            [Hit(**(row | {"view": View(row["view"])}), score=score) for row, score in rows]
        )
        begin += count
    return found
