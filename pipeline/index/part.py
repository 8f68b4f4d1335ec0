"""One part of an index, opened: FAISS search, filters, and reranking by the table's vectors.

Shapes: Q queries, K wanted rows, C candidates, N rows of the part, D dimensions, R rows of a block,
P pairs of query and candidate.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from pipeline.core import storage
from pipeline.core.arrays import Floats, Ints, Mask
from pipeline.core.errors import InputError
from pipeline.core.filters import Filter
from pipeline.features.row_reader import RowReader
from pipeline.index.faiss_io import local_copy, read_faiss, search_faiss
from pipeline.index.ids import RowIds
from pipeline.index.metadata import REBUILD_HINT, PartMetadata, SearchParams, check_files

FILTERED_EXACT_ROWS = 5_000
"""Matching rows up to which each is scored: about what a search over lists costs, and a narrow
filter loses no recall."""
FEW_HIDDEN = 0.05
"Share of the rows that a filter, or their removal, may hide without a dip of recall."
RERANK_BLOCK = 1_024
"Candidates' vectors in memory at a time: 8 MB at 2,048 dimensions, which stay in the core's cache."
NO_ROW = -1


class IndexPart:
    """A part of an index, opened for searching. Not thread-safe."""

    def __init__(
        self,
        folder: str,
        metadata: PartMetadata,
        reader: RowReader | None,
        on_disk: bool,
        scratch: str,
        verify: bool,
    ) -> None:
        """`reader`: of the table's vectors, None where single ones cannot be read. `scratch`:
        folder for copies of remote files. `verify`: whether every byte is compared with its
        checksum.

        Raises InputError where a file is damaged or missing.
        """
        check_files(folder, metadata.files, content=verify)
        self.metadata, self._reader = metadata, reader
        self.ids = RowIds(local_copy(storage.join(folder, metadata.ids), scratch))
        self.index = read_faiss(local_copy(storage.join(folder, metadata.faiss), scratch), on_disk)
        if not self.index.ntotal == len(self.ids) == metadata.rows:
            raise InputError(
                f"{folder} has {self.index.ntotal} vectors in {metadata.faiss}, {len(self.ids)} "
                f"rows in {metadata.ids}, expected {metadata.rows} of both; the index is damaged; "
                f"{REBUILD_HINT}"
            )
        self._table_parts = list(metadata.table_parts.items())
        self._kept_N: Mask | None = None
        if metadata.removed:
            self._kept_N = ~self.ids.mask(Filter(locations=frozenset(metadata.removed)))

    def allowed(self, where: Filter | Mask | None) -> Mask | None:
        """Which rows a search may return (N,); None: all. `where`: conditions on a row, or a mask
        of the whole index's.
        """
        if where is None:
            return self._kept_N
        if isinstance(where, Filter):
            mask_N = self.ids.mask(where)
        else:
            first = self.metadata.first_row
            mask_N = where[first : first + self.metadata.rows]
        return mask_N if self._kept_N is None else mask_N & self._kept_N

    def search(
        self, queries_QD: Floats, k: int, params: SearchParams, where: Filter | Mask | None = None
    ) -> tuple[Floats, Ints]:
        """Scores and rows (Q, K), counted within the part, best first; NO_ROW where fewer match."""
        allowed_N = self.allowed(where)
        if allowed_N is None:
            return self._search(queries_QD, k, params, None, self.metadata.rows)
        count = int(np.count_nonzero(allowed_N))
        if not count:
            return _empty_result(len(queries_QD), k)
        if count <= FILTERED_EXACT_ROWS and self._reader is not None:
            row_C = np.flatnonzero(allowed_N)
            rows_QC = np.broadcast_to(row_C, (len(queries_QD), count))
            return top_k(self._exact_scores(queries_QD, row_C), rows_QC, k)
        share = count / self.metadata.rows
        if share >= 1 - FEW_HIDDEN:
            params = filtered_params(params, share)
            return self._search(queries_QD, k, params, allowed_N, count)
        shown_Q = self._nearest_is_allowed(queries_QD, params, allowed_N)
        scores_QK, rows_QK = _empty_result(len(queries_QD), k)
        for some_Q, chosen in (
            (shown_Q, filtered_params(params, share)),
            (~shown_Q, hidden_params(params, share)),
        ):
            if some_Q.any():
                found = self._search(queries_QD[some_Q], k, chosen, allowed_N, count)
                scores_QK[some_Q], rows_QK[some_Q] = found
        return scores_QK, rows_QK

    def _search(
        self, queries_QD: Floats, k: int, params: SearchParams, allowed_N: Mask | None, count: int
    ) -> tuple[Floats, Ints]:
        """`search` over the index's codes, and the table's vectors for the best of them. `count`:
        of the allowed rows.
        """
        wanted = min(count, max(k, k * params.rerank_factor))
        scores_QC, rows_QC = search_faiss(self.index, queries_QD, wanted, k, params, allowed_N)
        if params.rerank_factor > 1 and self._reader is not None:
            scores_QC = rescored(queries_QD, rows_QC, self.vectors)
        return top_k(scores_QC, rows_QC, k)

    def _nearest_is_allowed(
        self, queries_QD: Floats, params: SearchParams, allowed_N: Mask
    ) -> Mask:
        """Whether a filter shows the place that a query looks most like (Q,), by the codes alone.
        Where it hides it, what is left is nearly all at one distance, in many lists.
        """
        _, rows_Q1 = search_faiss(self.index, queries_QD, 1, 1, params, None)
        return np.asarray(allowed_N[rows_Q1[:, 0]] & (rows_Q1[:, 0] != NO_ROW))

    def vectors(self, row_R: Ints) -> Floats:
        """The table's vectors (R, D) of these rows, which must ascend."""
        assert self._reader is not None
        columns = self.ids.take(row_R, ("table_part", "part_row"))
        part_R, part_row_R = (columns[name].to_numpy() for name in ("table_part", "part_row"))
        bounds = np.flatnonzero(np.diff(part_R, prepend=NO_ROW, append=NO_ROW))
        wanted = [
            (*self._table_parts[int(part_R[first])], part_row_R[first:last].astype(np.int64))
            for first, last in pairwise(bounds.tolist())
        ]
        vectors_RD: Floats = np.concatenate(self._reader.read_all(wanted), dtype=np.float32)
        return vectors_RD

    def _exact_scores(self, queries_QD: Floats, row_C: Ints) -> Floats:
        """Exact scores (Q, C) of the same candidates, which ascend, for all queries."""
        scores_QC = np.empty((len(queries_QD), len(row_C)), np.float32)
        for begin in range(0, len(row_C), RERANK_BLOCK):
            block = slice(begin, begin + RERANK_BLOCK)
            scores_QC[:, block] = queries_QD @ self.vectors(row_C[block]).T
        return scores_QC


def rescored(queries_QD: Floats, rows_QC: Ints, vectors: Callable[[Ints], Floats]) -> Floats:
    """Exact scores (Q, C) of each query's own candidates. `vectors`: those of rows that ascend."""
    scores_QC = np.full(rows_QC.shape, -np.inf, np.float32)
    query_P, column_P = np.nonzero(rows_QC != NO_ROW)
    row_P = rows_QC[query_P, column_P]
    order_P = np.argsort(row_P, kind="stable")
    for begin in range(0, len(order_P), RERANK_BLOCK):
        pairs = order_P[begin : begin + RERANK_BLOCK]
        query = query_P[pairs]
        scores_QC[query, column_P[pairs]] = np.einsum(
            "rd,rd->r", vectors(row_P[pairs]), queries_QD[query]
        )
    return scores_QC


def filtered_params(params: SearchParams, share: float) -> SearchParams:
    """Search parameters where a filter leaves a share of the rows: the fewer match, the more lists
    hold as many of them, and the farther these are and the nearer to each other, so that coarse
    codes order them worse: of embeddings .965 became .940 with as many candidates as without a
    filter.
    """
    factor = params.rerank_factor
    return replace(
        params,
        nprobe_or_ef=math.ceil(params.nprobe_or_ef / share),
        rerank_factor=math.ceil(factor / math.sqrt(share)) if factor > 1 else 1,
        list_ratio=0.0,
    )


def hidden_params(params: SearchParams, share: float) -> SearchParams:
    """`filtered_params` for queries whose nearest row the filter hides: those that
    `tune_hidden` found for a half of the rows.
    """
    factor = max(params.rerank_factor, params.hidden_rerank_factor)
    at_half = replace(
        params,
        nprobe_or_ef=params.hidden_nprobe_or_ef or 2 * params.nprobe_or_ef,
        rerank_factor=factor if params.rerank_factor > 1 else 1,
    )
    return filtered_params(at_half, 2 * share)


def _empty_result(queries: int, k: int) -> tuple[Floats, Ints]:
    return np.full((queries, k), -np.inf, np.float32), np.full((queries, k), NO_ROW, np.int64)


def top_k(scores_QC: Floats, rows_QC: Ints, k: int) -> tuple[Floats, Ints]:
    """The K best of C candidates: higher scores first, then the lower row; NO_ROW last."""
    scores_QC = np.where(rows_QC == NO_ROW, np.float32(-np.inf), scores_QC)
    order_QK = np.lexsort((rows_QC, -scores_QC), axis=1)[:, :k]
    scores_QK = np.take_along_axis(scores_QC, order_QK, 1)
    rows_QK = np.take_along_axis(rows_QC, order_QK, 1)
    missing = k - order_QK.shape[1]
    if missing > 0:
        more_scores, more_rows = _empty_result(len(scores_QC), missing)
        scores_QK = np.concatenate([scores_QK, more_scores], axis=1)
        rows_QK = np.concatenate([rows_QK, more_rows], axis=1)
    return scores_QK, rows_QK
