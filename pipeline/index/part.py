"""One part of an index, opened: what FAISS finds in it, what the table's vectors make of that,
which of its rows may answer.

Shapes: Q queries, K rows wanted, C candidates, N rows of the part, D dimensions.
"""

from itertools import pairwise
from typing import Any

import faiss
import numpy as np

from pipeline.core import storage
from pipeline.core.arrays import Ints, Mask
from pipeline.core.errors import InputError
from pipeline.features.row_reader import RowReader
from pipeline.features.table import Floats
from pipeline.index.filters import Filter
from pipeline.index.ids import RowIds, local_copy
from pipeline.index.metadata import REBUILD_HINT, PartMetadata, SearchParams, check_files
from pipeline.index.plan import RERANK_FACTOR

FILTERED_EXACT_ROWS = 5_000
"""Allowed rows up to which each is scored: about what a search over lists costs, and no recall is
lost to a narrow filter."""
RERANK_BLOCK = 1_024
"Vectors of candidates in memory at a time: 8 MB at 2,048 dimensions, which stay near the core."
NO_ROW = -1
FAISS: Any = faiss  # whose types know nothing of its keyword arguments


class IndexPart:
    """A part of an index, opened for searching. Not for several threads at once."""

    def __init__(
        self,
        folder: str,
        facts: PartMetadata,
        reader: RowReader | None,
        on_disk: bool,
        scratch: str,
        whole: bool,
    ) -> None:
        """`reader`: of the table's vectors, None where they cannot be read singly. `scratch`: where remote files are copied to.
        `whole`: whether every byte is looked at.

        Raises InputError where a file is damaged or gone.
        """
        check_files(folder, facts.files, whole)
        self.facts, self._reader = facts, reader
        self.ids = RowIds(local_copy(storage.join(folder, facts.ids), scratch))
        self.index = read_faiss(local_copy(storage.join(folder, facts.faiss), scratch), on_disk)
        if not self.index.ntotal == len(self.ids) == facts.rows:
            raise InputError(
                f"{folder} has {self.index.ntotal} vectors in {facts.faiss}, {len(self.ids)} rows in {facts.ids}, expected "
                f"{facts.rows} of both; the index is damaged; {REBUILD_HINT}"
            )
        self._table_parts = list(facts.table_parts.items())
        self._removed = self._mask_of_removed()

    def allowed(self, where: Filter | None) -> Mask | None:
        """Which rows may answer (N,); None: all."""
        if where is None:
            return self._removed
        mask = self.ids.mask(where)
        return mask if self._removed is None else mask & self._removed

    def search(
        self, queries_QD: Floats, k: int, effort: SearchParams, where: Filter | None = None
    ) -> tuple[Floats, Ints]:
        """Scores and rows (Q, K), counted within the part, best first; NOBODY where fewer may
        answer.
        """
        allowed_N = self.allowed(where)
        count = self.facts.rows if allowed_N is None else int(np.count_nonzero(allowed_N))
        if not count:
            return _empty_result(len(queries_QD), k)
        if allowed_N is not None and count <= FILTERED_EXACT_ROWS and self._reader is not None:
            rows_C = np.flatnonzero(allowed_N)
            return _top_k(
                self._scores(queries_QD, rows_C),
                np.broadcast_to(rows_C, (len(queries_QD), count)),
                k,
            )
        wanted = min(count, max(k, k * effort.candidates))
        breadth = effort.breadth
        if (
            allowed_N is not None
        ):  # the fewer may answer, the more lists it takes to meet as many of them
            breadth = int(np.ceil(breadth * self.facts.rows / count))
        scores_QC, rows_QC = self.index.search(
            queries_QD, wanted, params=faiss_parameters(self.index, breadth, allowed_N)
        )
        if effort.candidates > 1 and self._reader is not None:
            scores_QC = self._refined(queries_QD, rows_QC)
        return _top_k(scores_QC, rows_QC, k)

    def vectors(self, row_R: Ints) -> Floats:
        """The table's vectors (R, D) of these rows, which ascend."""
        assert self._reader is not None
        places = self.ids.take(row_R, ("table_part", "part_row"))
        part_R, place_R = (places[name].to_numpy() for name in ("table_part", "part_row"))
        bounds = np.flatnonzero(np.diff(part_R, prepend=NO_ROW, append=NO_ROW))
        blocks = []
        for first, last in pairwise(bounds.tolist()):
            name, shard = self._table_parts[int(part_R[first])]
            blocks.append(self._reader.read(name, shard, place_R[first:last].astype(np.int64)))
        found_RD: Floats = np.concatenate(blocks, dtype=np.float32)
        return found_RD

    def _scores(self, queries_QD: Floats, rows_C: Ints) -> Floats:
        """Exact scores (Q, C) of the same candidates, which ascend, for all queries."""
        scores_QC = np.empty((len(queries_QD), len(rows_C)), np.float32)
        for begin in range(0, len(rows_C), RERANK_BLOCK):
            block = slice(begin, begin + RERANK_BLOCK)
            scores_QC[:, block] = queries_QD @ self.vectors(rows_C[block]).T
        return scores_QC

    def _refined(self, queries_QD: Floats, rows_QC: Ints) -> Floats:
        """Exact scores (Q, C) of each query's own candidates."""
        scores_QC = np.full(rows_QC.shape, -np.inf, np.float32)
        query_P, column_P = np.nonzero(rows_QC != NO_ROW)
        row_P = rows_QC[query_P, column_P]
        order_P = np.argsort(row_P, kind="stable")
        for begin in range(0, len(order_P), RERANK_BLOCK):
            pairs = order_P[begin : begin + RERANK_BLOCK]
            query = query_P[pairs]
            scores_QC[query, column_P[pairs]] = np.einsum(
                "rd,rd->r", self.vectors(row_P[pairs]), queries_QD[query]
            )
        return scores_QC

    def _mask_of_removed(self) -> Mask | None:
        if not self.facts.removed:
            return None
        return ~self.ids.mask(Filter(locations=frozenset(self.facts.removed)))


def read_faiss(path: str, on_disk: bool) -> Any:
    """A FAISS index from a local file; `on_disk`: its lists are mapped, not read.

    Raises InputError where FAISS cannot read it.
    """
    try:
        return faiss.read_index(path, faiss.IO_FLAG_MMAP if on_disk else 0)
    except RuntimeError as error:
        reason = str(error).rsplit("Error: ", 1)[-1].splitlines()[0]
        raise InputError(f"{path} is damaged ({reason}); {REBUILD_HINT}") from None


def faiss_parameters(index: Any, breadth: int, allowed_N: Mask | None) -> Any:
    """FAISS's parameters of a search in any index that we build: how broad, and which rows may
    answer.
    """
    kind = FAISS.downcast_index(
        index
    )  # under another name: it lives only as long as what it is a view of
    if isinstance(kind, FAISS.IndexPreTransform):
        return FAISS.SearchParametersPreTransform(
            index_params=faiss_parameters(kind.index, breadth, allowed_N)
        )
    if isinstance(kind, FAISS.IndexRefine):
        inner = faiss_parameters(kind.base_index, breadth, allowed_N)
        return FAISS.IndexRefineSearchParameters(k_factor=RERANK_FACTOR, base_index_params=inner)
    chosen: dict[str, Any] = {}
    if allowed_N is not None:
        chosen["sel"] = FAISS.IDSelectorBitmap(np.packbits(allowed_N, bitorder="little"))
    if isinstance(kind, FAISS.IndexIVF):
        return FAISS.SearchParametersIVF(nprobe=min(breadth, kind.nlist), **chosen)
    if isinstance(kind, FAISS.IndexHNSW):
        return FAISS.SearchParametersHNSW(efSearch=breadth, **chosen)
    return FAISS.SearchParameters(**chosen)


def _without_graph(index: Any) -> Any:
    """What an index scores exhaustively: of a graph its vectors, which narrow filters cut off from
    each other.
    """
    return FAISS.downcast_index(index.storage) if isinstance(index, FAISS.IndexHNSW) else index


def _empty_result(queries: int, k: int) -> tuple[Floats, Ints]:
    return np.full((queries, k), -np.inf, np.float32), np.full((queries, k), NO_ROW, np.int64)


def _top_k(scores_QC: Floats, rows_QC: Ints, k: int) -> tuple[Floats, Ints]:
    """The K best of C candidates: higher scores first, at equal scores the lower row; NOBODY last."""
    scores_QC = np.where(rows_QC == NO_ROW, np.float32(-np.inf), scores_QC)
    order_QK = np.lexsort((rows_QC, -scores_QC), axis=1)[:, :k]
    found = np.take_along_axis(scores_QC, order_QK, 1), np.take_along_axis(rows_QC, order_QK, 1)
    missing = k - order_QK.shape[1]
    if missing <= 0:
        return found
    more = _empty_result(len(scores_QC), missing)
    return np.concatenate([found[0], more[0]], axis=1), np.concatenate([found[1], more[1]], axis=1)
