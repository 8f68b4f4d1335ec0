"""An index spread over a cluster: each Ray actor opens some of its parts, and all answer a query.

Searches return the same hits as those of pipeline/index/searcher.py's Index, which each actor has
one of.
Shapes: Q queries, K wanted rows, D dimensions.
"""

from typing import Any

import numpy as np
import pyarrow as pa
import ray

from pipeline.core import cluster, storage
from pipeline.core.arrays import Floats, Ints
from pipeline.core.errors import InputError
from pipeline.core.filters import Filter
from pipeline.index.metadata import SearchParams, read_metadata
from pipeline.index.part import NO_ROW
from pipeline.index.searcher import Hit, Index, make_hits, merge_results

PartResult = tuple[Floats, Ints, pa.Table]
"Scores and row numbers (Q, K), and the ids of these rows."


class DistributedIndex:
    """An index whose parts are opened by actors. Closing it, or leaving its `with`, ends them."""

    def __init__(self, path: str, actors: int, cores: int = 1) -> None:
        """`cores`: of each actor. There are at most as many actors as parts, for an actor opens
        whole parts.

        Raises InputError when there is no index at `path`, or it is damaged.
        """
        self.metadata = read_metadata(path)
        self.dimension = self.metadata.dimension
        cluster.connect()
        remote: Any = ray.remote(num_cpus=cores)(_PartServer)
        parts = len(self.metadata.parts)
        shares = np.array_split(np.arange(parts), min(actors, parts))
        self._actors = [
            remote.remote(storage.absolute(path), share.tolist(), cores) for share in shares
        ]
        self._counts = [actor.rows.remote() for actor in self._actors]
        try:
            self._rows: int = sum(_get(self._counts))
        except InputError:
            self.close()
            raise

    def __enter__(self) -> "DistributedIndex":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        """Rows that a search can return."""
        return self._rows

    def close(self) -> None:
        for actor, count in zip(self._actors, self._counts, strict=True):
            cluster.stop_actor(actor, count)
        self._actors, self._counts = [], []

    def search(
        self,
        queries_QD: Floats,
        k: int = 10,
        where: Filter | None = None,
        params: SearchParams | None = None,
    ) -> list[list[Hit]]:
        """As `Index.search`. All actors search their parts at the same time."""
        queries = ray.put(np.ascontiguousarray(queries_QD, np.float32))
        results: list[PartResult] = _get(
            [actor.search.remote(queries, k, where, params) for actor in self._actors]
        )
        scores_QK, rows_QK = merge_results([(scores, rows) for scores, rows, _ in results], k)
        ids = pa.concat_tables([ids for _, _, ids in results])
        all_rows = (row for _, rows, _ in results for row in rows[rows != NO_ROW].tolist())
        position = {row: number for number, row in enumerate(all_rows)}
        wanted = [position[row] for row in rows_QK[rows_QK != NO_ROW].tolist()]
        return make_hits(scores_QK, rows_QK, ids.take(pa.array(wanted, pa.int64())))


class _PartServer:
    """The actor: some parts of an index."""

    def __init__(self, path: str, parts: list[int], threads: int) -> None:
        self._index: Index | None = None
        self._error: InputError | None = None
        try:
            self._index = Index(path, parts, threads)
        except InputError as error:  # raised here, the caller would see a dead actor
            self._error = error

    def rows(self) -> int:
        return len(self._opened())

    def search(
        self, queries_QD: Floats, k: int, where: Filter | None, params: SearchParams | None
    ) -> PartResult:
        index = self._opened()
        scores_QK, rows_QK = index.search_rows(queries_QD, k, where, params)
        return scores_QK, rows_QK, index.ids_of(rows_QK)

    def _opened(self) -> Index:
        if self._index is None:
            raise self._error or AssertionError("an index or an error")
        return self._index


def _get(results: list[Any]) -> Any:
    """The actors' results. An InputError of an actor is raised as itself."""
    try:
        return ray.get(results)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None
