"""An index on disk, opened for searching: its parts are searched, their results merged, and rows
become hits with key, location and position.

Built by pipeline/index/build.py, extended by pipeline/index/update.py, spread over a cluster by
pipeline/index/distributed.py.
Shapes: Q queries, K wanted rows, D dimensions, M candidates of all parts.
"""

import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import faiss
import numpy as np
import pyarrow as pa

from pipeline.core.arrays import Floats, Ints, Mask
from pipeline.core.errors import InputError
from pipeline.core.filters import Filter
from pipeline.core.records import View
from pipeline.features.row_reader import RowReader, supports_row_reads
from pipeline.index.metadata import IndexMetadata, SearchParams, read_metadata
from pipeline.index.part import NO_ROW, IndexPart

HASHED_ON_OPEN_BYTES = 1 << 30
"Bytes of an index up to which opening it compares checksums: a second, about."


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
    "Cosine similarity, -1 to 1; computed from compressed vectors where the index has only these."
    side_m: float | None = None
    "Side of the ground that it shows, metres; null where its corners are not known."


class Searchable(Protocol):
    """An index of this process, or one that is spread over a cluster."""

    dimension: int

    def __len__(self) -> int: ...

    def search(
        self, queries_QD: Floats, k: int = 10, where: Filter | None = None
    ) -> list[list[Hit]]: ...


class Index:
    """An index on disk, opened for searching. Not thread-safe: FAISS spreads a search over the
    cores itself.
    """

    def __init__(
        self,
        path: str,
        parts: Sequence[int] | None = None,
        threads: int | None = None,
        metadata: IndexMetadata | None = None,
        verify: bool | None = None,
    ) -> None:
        """`parts`: numbers of those to open; all by default. `threads`: of FAISS; by default one
        per core. `metadata`: where index.json is not written yet. `verify`: whether every byte is
        compared with its checksum; by default it is where the parts are small.

        Raises InputError when there is no index at `path`, or it is damaged.
        """
        self.path, self.metadata = path, metadata or read_metadata(path)
        self.dimension = self.metadata.dimension
        # Ray sets OMP_NUM_THREADS to a task's cores before FAISS is loaded; in its jobs to one.
        faiss.omp_set_num_threads(threads or os.cpu_count() or 1)
        # A file that is mapped stays readable when its name is gone.
        with tempfile.TemporaryDirectory() as scratch:
            self._parts = list(open_parts(path, self.metadata, scratch, parts, verify))

    @property
    def parts(self) -> list[IndexPart]:
        """The opened parts, in the order of their rows."""
        return self._parts

    def __len__(self) -> int:
        """Rows that a search can return."""
        removed = sum(
            int(np.count_nonzero(~mask_N))
            for part in self._parts
            if (mask_N := part.allowed(None)) is not None
        )
        return sum(part.metadata.rows for part in self._parts) - removed

    def search(
        self,
        queries_QD: Floats,
        k: int = 10,
        where: Filter | None = None,
        params: SearchParams | None = None,
    ) -> list[list[Hit]]:
        """The K best rows of each query that match the filter, best first; fewer where fewer match.

        `params`: by default those that the index was measured with. Raises InputError when the
        queries have another dimension.
        """
        scores_QK, rows_QK = self.search_rows(queries_QD, k, where, params)
        return make_hits(scores_QK, rows_QK, self.ids_of(rows_QK))

    def search_rows(
        self,
        queries_QD: Floats,
        k: int = 10,
        where: Filter | Mask | None = None,
        params: SearchParams | None = None,
    ) -> tuple[Floats, Ints]:
        """Scores and row numbers (Q, K) in the whole index, best first; NO_ROW where fewer rows
        match. `where`: conditions on a row, or which of the index's rows match.
        """
        queries_QD = np.ascontiguousarray(queries_QD, np.float32)
        if queries_QD.ndim != 2 or queries_QD.shape[1] != self.dimension:
            raise InputError(
                f"the queries have the shape {queries_QD.shape}, expected (queries, "
                f"{self.dimension}); embed them with the network of the index"
            )
        results = []
        for part in self._parts:
            scores_QK, rows_QK = part.search(
                queries_QD, k, params or self.metadata.search_params, where
            )
            rows_QK = np.where(rows_QK == NO_ROW, NO_ROW, rows_QK + part.metadata.first_row)
            results.append((scores_QK, rows_QK))
        return merge_results(results, k)

    def ids_of(self, rows_QK: Ints) -> pa.Table:
        """Key, location, view and position of the rows, in their order, without NO_ROW."""
        row_R = rows_QK[rows_QK != NO_ROW]
        order: list[Ints] = [np.empty(0, np.int64)]
        tables = []
        for part in self._parts:
            first, count = part.metadata.first_row, part.metadata.rows
            in_part = np.flatnonzero((row_R >= first) & (row_R < first + count))
            order.append(in_part)
            tables.append(part.ids.take(row_R[in_part] - first))
        back_R = np.empty(len(row_R), np.int64)
        back_R[np.concatenate(order)] = np.arange(len(row_R))
        return pa.concat_tables(tables).take(pa.array(back_R))


def open_parts(
    path: str,
    metadata: IndexMetadata,
    scratch: str,
    parts: Sequence[int] | None = None,
    verify: bool | None = None,
) -> Iterator[IndexPart]:
    """The parts of an index, opened.

    By default every byte is compared with its checksum where the parts are small: FAISS may end
    the process over a damaged file.
    """
    readable = supports_row_reads(metadata.table)
    reader = RowReader(metadata.table, metadata.dimension) if readable else None
    wanted = [part for n, part in enumerate(metadata.parts) if parts is None or n in parts]
    if verify is None:
        sizes = (file.bytes for part in wanted for file in part.files.values())
        verify = sum(sizes) <= HASHED_ON_OPEN_BYTES
    for part in wanted:
        yield IndexPart(path, part, reader, metadata.on_disk, scratch, verify)


def merge_results(results: Sequence[tuple[Floats, Ints]], k: int) -> tuple[Floats, Ints]:
    """The K best of several parts' results: higher scores first, at equal scores the lower row,
    NO_ROW last.
    """
    scores_QM = np.concatenate([scores for scores, _ in results], axis=1)
    rows_QM = np.concatenate([rows for _, rows in results], axis=1)
    rank_QM = np.where(rows_QM == NO_ROW, np.iinfo(np.int64).max, rows_QM)
    order_QK = np.lexsort((rank_QM, -scores_QM), axis=1)[:, :k]
    return np.take_along_axis(scores_QM, order_QK, 1), np.take_along_axis(rows_QM, order_QK, 1)


def make_hits(scores_QK: Floats, rows_QK: Ints, ids: pa.Table) -> list[list[Hit]]:
    """The hits of each query, from the results of `search_rows` and `ids_of`."""
    rows, hits, begin = ids.to_pylist(), [], 0
    counts = np.count_nonzero(rows_QK != NO_ROW, axis=1).tolist()
    for scores_K, count in zip(scores_QK, counts, strict=True):
        scored = zip(rows[begin : begin + count], scores_K[:count].tolist(), strict=True)
        hits.append(
            [Hit(**(row | {"view": View(row["view"])}), score=score) for row, score in scored]
        )
        begin += count
    return hits
