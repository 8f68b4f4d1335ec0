"""An index spread over a cluster: Ray actors hold some of its parts each and answer a query
together.

The same questions and answers as pipeline/index/searcher.py's Index, which it is made of.
Shapes: Q queries, K rows wanted, D dimensions.
"""

from typing import Any

import numpy as np
import pyarrow as pa
import ray

from pipeline.core import cluster, storage
from pipeline.core.arrays import Ints
from pipeline.core.errors import InputError
from pipeline.features.table import Floats
from pipeline.index.filters import Filter
from pipeline.index.metadata import SearchParams, metadata_dict, read_metadata
from pipeline.index.part import NO_ROW
from pipeline.index.searcher import Hit, Index, make_hits, merge_results

PartResult = tuple[Floats, Ints, pa.Table]


class DistributedIndex:
    """An index whose parts are held by actors. Closing it, or leaving its `with`, ends them."""

    def __init__(self, path: str, actors: int, cores: int = 1) -> None:
        """`cores`: of each actor. More actors than parts are not made: a part is the smallest piece
        that an actor can hold.

        Raises InputError when there is no index at `path`, or it is damaged.
        """
        told = read_metadata(path)
        self.facts = metadata_dict(told)
        self.dimension = told.dimension
        cluster.connect()
        kind: Any = ray.remote(num_cpus=cores)(_PartServer)
        shares = np.array_split(np.arange(len(told.parts)), min(actors, len(told.parts)))
        self._actors = [
            kind.remote(storage.absolute(path), share.tolist(), cores) for share in shares
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
        """Rows that may answer."""
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
        effort: SearchParams | None = None,
    ) -> list[list[Hit]]:
        """As `Index.search`. Every actor searches its parts at the same time."""
        queries = ray.put(np.ascontiguousarray(queries_QD, np.float32))
        found: list[PartResult] = _get(
            [actor.search.remote(queries, k, where, effort) for actor in self._actors]
        )
        scores_QK, rows_QK = merge_results([(scores, rows) for scores, rows, _ in found], k)
        names = pa.concat_tables([names for _, _, names in found])
        at = {
            row: place
            for place, row in enumerate(
                row for _, rows, _ in found for row in rows[rows != NO_ROW].tolist()
            )
        }
        wanted = [at[row] for row in rows_QK[rows_QK != NO_ROW].tolist()]
        return make_hits(scores_QK, rows_QK, names.take(pa.array(wanted, pa.int64())))


class _PartServer:
    """The actor: some parts of an index."""

    def __init__(self, path: str, parts: list[int], threads: int) -> None:
        self._index: Index | None = None
        self._refusal: InputError | None = None
        try:
            self._index = Index(path, parts, threads)
        except InputError as error:  # raised here it would reach the caller as a death of the actor
            self._refusal = error

    def rows(self) -> int:
        return len(self._opened())

    def search(
        self, queries_QD: Floats, k: int, where: Filter | None, effort: SearchParams | None
    ) -> PartResult:
        scores_QK, rows_QK = self._opened().search_rows(queries_QD, k, where, effort)
        return scores_QK, rows_QK, self._opened().names(rows_QK)

    def _opened(self) -> Index:
        if self._index is None:
            raise self._refusal or AssertionError("an index or a refusal")
        return self._index


def _get(answers: list[Any]) -> Any:
    """What actors answer; an InputError of theirs as the sentence that it is."""
    try:
        return ray.get(answers)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None
