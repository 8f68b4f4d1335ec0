"""Tries a plan on a sample of the gallery's vectors before it is built: recall of its searches,
queries a second, p99, bytes a row, and the seconds that the whole gallery will take.

The plan is built twice, over the sample and over a quarter of it. What of the recall is lost at the
most thorough search grows with the rows by a power that these two give; it is extrapolated to all
rows. Times grow by the work that each kind of index does for a row or a query.
Shapes: S rows of the sample, Q queries, K wanted rows, D dimensions.
"""

import math
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.core.arrays import Floats, Ints, Mask
from pipeline.features.row_reader import RowReader, supports_row_reads
from pipeline.features.table import FeatureTable
from pipeline.index.faiss_io import FAISS, faiss_parameters, search_faiss
from pipeline.index.metadata import SearchParams
from pipeline.index.part import FILTERED_EXACT_ROWS, NO_ROW, filtered_params, rescored, top_k
from pipeline.index.planning.choice import PlanTrial, TrialPoint
from pipeline.index.planning.plan import ROWS_PER_LIST, TRAINING_SHARE, GallerySpec, IndexPlan
from pipeline.index.train import new_index, sample_rows, train_index
from pipeline.index.tuning.ground_truth import NEIGHBOURS, RecallQueries
from pipeline.index.tuning.recall import measure_recall, measure_speed
from pipeline.index.tuning.search_params import cheaper_params, search_param_grid

TRIAL_SHARE = 1 / 16
"Of the rows: a trial takes a sixteenth of the building, about."
MIN_TRIAL_ROWS, MAX_TRIAL_ROWS = 8_192, 32_768
TRIAL_QUERIES = 256
"Rows of the sample that are not indexed."
TRIAL_SECONDS = 0.05
"For which a setting's batches are timed, and its single ones."
QUARTER = 4
KMEANS_ROUNDS, LEARNED_PER_LIST = 10, 256
"Of FAISS's k-means for lists, and the most rows that it learns a centre from."
MOST_GROWTH = 0.5
"""Largest power of the rows by which lost recall is taken to grow: two samples give it roughly, and
one lost neighbour in a thousand is no trend."""


def trial_rows(gallery: GallerySpec) -> int:
    """Rows of the sample, its queries included; what FAISS copies of them fits the memory."""
    memory = int(gallery.budget * TRAINING_SHARE / (2 * 4 * gallery.dimension))
    wanted = max(MIN_TRIAL_ROWS, int(gallery.rows * TRIAL_SHARE))
    return min(gallery.rows, memory, MAX_TRIAL_ROWS, wanted)


@dataclass(frozen=True, kw_only=True)
class Sample:
    """Rows of the gallery that plans are tried on."""

    vectors_SD: Floats
    read: Callable[[Ints], Floats]
    """The vectors (R, D) of rows of the sample, which ascend, as a search reads them: from the
    table."""


def take_sample(table: FeatureTable, rows_of_part: dict[str, int], rows: int) -> Sample:
    """A sample of about `rows` rows of a table."""
    row_S, vectors_SD = sample_rows(table, rows_of_part, rows)
    if not supports_row_reads(table.path):
        return Sample(vectors_SD=vectors_SD, read=lambda row_R: vectors_SD[row_R])
    reader, names = RowReader(table.path, table.dimension), list(rows_of_part)
    first_P = np.cumsum([0, *rows_of_part.values()])

    def read(row_R: Ints) -> Floats:
        part_R = np.searchsorted(first_P, row_S[row_R], side="right") - 1
        blocks = []
        for part in np.unique(part_R).tolist():
            rows_in_part = row_S[row_R][part_R == part] - first_P[part]
            blocks.append(reader.read(names[part], table.shards[names[part]], rows_in_part))
        vectors_RD: Floats = np.concatenate(blocks, dtype=np.float32)
        return vectors_RD

    return Sample(vectors_SD=vectors_SD, read=read)


def try_plan(plan: IndexPlan, gallery: GallerySpec, sample: Sample) -> PlanTrial:
    """Build a plan over a sample and search it: from the fastest search to the first that is
    expected to reach the recall, and by the most thorough one where none is.
    """
    count = len(sample.vectors_SD)
    queries = min(TRIAL_QUERIES, count // 2)
    query_Q = np.unique(np.linspace(0, count - 1, queries).astype(np.int64))
    kept_S = np.setdiff1d(np.arange(count), query_Q)
    queries_QD = sample.vectors_SD[query_Q]
    some_S = kept_S[: math.ceil(len(kept_S) / QUARTER)]
    lost_of_quarter = _SampleIndex(plan, gallery, sample, some_S).lost_at_most(queries_QD)
    whole = _SampleIndex(plan, gallery, sample, kept_S)
    lost = whole.lost_at_most(queries_QD)
    noise = 1 / (2 * NEIGHBOURS * queries)
    power = math.log((lost + noise) / (lost_of_quarter + noise)) / math.log(QUARTER)
    growth = (gallery.rows / len(kept_S)) ** min(MOST_GROWTH, max(0.0, power))
    points: list[TrialPoint] = []
    for params in whole.grid():
        points.append(whole.point(params, queries_QD, growth))
        if points[-1].recall >= gallery.target_recall:
            least = 1 - (1 - gallery.target_recall) / growth
            points.append(whole.point(whole.cheaper(params, queries_QD, least), queries_QD, growth))
            break
    return PlanTrial(
        plan=plan,
        points=tuple(points),
        bytes_per_row=len(FAISS.serialize_index(whole.index)) / len(kept_S),
        build_seconds=whole.build_seconds,
        sample_rows=len(kept_S),
    )


@dataclass(frozen=True, kw_only=True)
class BuildTimes:
    """Seconds of building an index over a sample."""

    training: float
    adding: float
    comparing: float
    "Of all rows with the centres of all lists, as adding does once."
    learned: float
    "Share of the rows that the centres are learned from."


def expected_seconds(
    times: BuildTimes, more_training: float, more_rows: float, more_lists: float, deeper: float
) -> float:
    """Seconds of building the whole gallery, which has so many times the sample's rows to train on,
    rows and lists; `deeper`: as many times as long to find a row's neighbours in a graph.

    Only comparing rows with centres takes longer where there are more lists. Learning the centres
    compares KMEANS_ROUNDS times.
    """
    rounds = min(times.training, KMEANS_ROUNDS * times.comparing * times.learned)
    training = rounds / times.learned * more_lists + times.training - rounds
    once = min(times.adding, times.comparing)
    adding = once * more_lists + (times.adding - once) * deeper
    return training * more_training + adding * more_rows


def _comparing_seconds(index: Any, rows_SD: Floats) -> float:
    """Seconds of finding each row's list; of a projection's index, in as many directions."""
    ivf = FAISS.extract_index_ivf(index)
    reduced_SD = np.ascontiguousarray(rows_SD[:, : ivf.d])
    start = time.perf_counter()
    ivf.quantizer.search(reduced_SD, 1)
    return time.perf_counter() - start


class _SampleIndex:
    """A plan, built over a sample in memory."""

    def __init__(self, plan: IndexPlan, gallery: GallerySpec, sample: Sample, kept_S: Ints) -> None:
        """`kept_S`: rows of the sample, which ascend."""
        rows_SD = sample.vectors_SD[kept_S]
        self._plan, self._gallery, self._rows_SD = plan, gallery, rows_SD
        self._read, self._kept_S = sample.read, kept_S
        rows, share = len(rows_SD), len(rows_SD) / gallery.rows
        lists = _lists(plan.factory)
        fewer = _fewer_lists(lists, share, rows)
        factory = _with_lists(plan.factory, fewer)
        self.index: Any = new_index(factory, gallery.dimension)
        start = time.perf_counter()
        train_index(self.index, factory, rows_SD)
        trained = time.perf_counter()
        self.index.add(rows_SD)
        added = time.perf_counter()
        graph = math.log(gallery.rows) / math.log(rows) if _is_graph(self.index) else 1.0
        more_lists = lists / fewer if lists else 1.0
        self.build_seconds = expected_seconds(
            BuildTimes(
                training=trained - start,
                adding=added - trained,
                comparing=_comparing_seconds(self.index, rows_SD) if lists else 0.0,
                learned=min(rows, LEARNED_PER_LIST * fewer) / rows if lists else 1.0,
            ),
            more_training=min(plan.training_rows, gallery.rows) / rows,
            more_rows=1 / share,
            more_lists=more_lists,
            deeper=graph,
        )
        # A query compares with every centre and with the rows of some lists.
        lengths = (gallery.rows / lists) / (rows / fewer) if lists else 1 / share
        self._slower = graph if _is_graph(self.index) else max(more_lists, lengths)
        self._allowed_S = self._mask()
        self._exact_QK: Ints | None = None

    def _mask(self) -> Mask | None:
        """Rows that a filter of the expected selectivity leaves; None where it leaves all, or so
        few that a search compares each with the query.
        """
        share = self._gallery.selectivity
        if share >= 1 or share * self._gallery.rows <= FILTERED_EXACT_ROWS:
            return None
        allowed_S: Mask = np.random.default_rng(0).random(len(self._rows_SD)) < share
        return allowed_S

    def grid(self) -> Iterator[SearchParams]:
        """The settings of its search, from the fastest to the most thorough."""
        return search_param_grid(self.index, self._plan.refine)

    def search_rows(
        self, queries_QD: Floats, k: int = NEIGHBOURS, params: SearchParams | None = None
    ) -> tuple[Floats, Ints]:
        """As `Index.search_rows`, over the sample."""
        assert params is not None
        if self._allowed_S is not None:
            share = max(1, int(np.count_nonzero(self._allowed_S))) / len(self._rows_SD)
            params = filtered_params(params, share)
        wanted = min(len(self._rows_SD), k * params.rerank_factor)
        scores_QC, rows_QC = search_faiss(
            self.index, queries_QD, wanted, k, params, self._allowed_S
        )
        if params.rerank_factor > 1:
            scores_QC = rescored(queries_QD, rows_QC, lambda row_R: self._read(self._kept_S[row_R]))
        return top_k(scores_QC, rows_QC, k)

    def lost_at_most(self, queries_QD: Floats) -> float:
        """Share of exact search's ten nearest that the most thorough search does not find."""
        *_, hardest = self.grid()
        return 1 - measure_recall(self, self._queries(queries_QD), hardest)[1]

    def cheaper(self, params: SearchParams, queries_QD: Floats, target: float) -> SearchParams:
        """Parameters of less work that reach the target as well."""
        queries = self._queries(queries_QD)
        tuned = params, *measure_recall(self, queries, params)
        return cheaper_params(self, queries, tuned, target)[0]

    def point(self, params: SearchParams, queries_QD: Floats, growth: float) -> TrialPoint:
        """One setting, measured. `growth`: of the lost recall, up to all rows."""
        recall = measure_recall(self, self._queries(queries_QD), params)[1]
        speed = measure_speed(
            lambda some_QD: self.search_rows(some_QD, params=params),
            queries_QD,
            self._gallery.batch,
            TRIAL_SECONDS,
        )
        return TrialPoint(
            nprobe_or_ef=params.nprobe_or_ef,
            rerank_factor=params.rerank_factor,
            list_ratio=params.list_ratio,
            recall=max(0.0, 1 - (1 - recall) * growth),
            sample_recall=recall,
            queries_per_second=speed["queries_per_second"] / self._slower,
            p99_ms=speed["p99_ms"] * self._slower,
        )

    def _queries(self, queries_QD: Floats) -> RecallQueries:
        if self._exact_QK is None:
            flat = new_index("Flat", self._gallery.dimension)
            flat.add(self._rows_SD)
            wanted = min(NEIGHBOURS, len(self._rows_SD))
            if self._allowed_S is not None:
                wanted = min(wanted, int(self._allowed_S.sum()))
            parameters = faiss_parameters(flat, 1, self._allowed_S)
            self._exact_QK = flat.search(queries_QD, wanted, params=parameters)[1]
        return RecallQueries(
            queries_QD=queries_QD,
            exact_QK=self._exact_QK,
            own_row_Q=np.full(len(queries_QD), NO_ROW),
            source="rows of the sample that are not indexed",
        )


def _is_graph(index: Any) -> bool:
    kind = FAISS.downcast_index(index)
    if isinstance(kind, FAISS.IndexPreTransform):
        kind = FAISS.downcast_index(kind.index)
    return isinstance(kind, FAISS.IndexHNSW)


def _lists(factory: str) -> int:
    """Inverted lists of a factory string; 0: none."""
    found = re.search(r"IVF(\d+)", factory)
    return int(found[1]) if found else 0


def _fewer_lists(lists: int, share: float, rows: int) -> int:
    """Lists of a sample: fewer by the root of its share, as the planner's are; a power of two."""
    if not lists:
        return 0
    most = max(1, min(lists, rows // ROWS_PER_LIST))
    return int(2 ** math.floor(math.log2(max(1, min(most, lists * math.sqrt(share))))))


def _with_lists(factory: str, lists: int) -> str:
    return re.sub(r"IVF\d+", f"IVF{lists}", factory)
