"""The plans of a gallery's index: rows, dimension, memory and wanted recall in, factory strings and
what they take out, the most promising first. Pure functions.

Plans that fit the memory and whose family is known to reach the recall come first, from the fastest
to the slowest; then the others, the one with the highest recall first. `trial.py` tries them.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass

from pipeline.core.errors import InputError
from pipeline.index.planning.families import EXACT, FAMILIES, IndexFamily, Refine, factory_string

EXACT_ROWS = 100_000
"Rows up to which exact search is fast enough to need no planning."
GRAPH_ROWS = 500_000
"Rows up to which a graph is built: it takes several times as long as lists, in one piece."
PROCESS_BYTES = 300e6
"Python, FAISS, Arrow and Ray before the first vector."
BLOCK_BYTES = 4 * 64e6
"Blocks of the table on their way into the index, and FAISS's own copies of them."
MASK_BYTES = 1.125
"""Of a row while a filter is applied: a boolean and a bit. Ids and positions are mapped from the
disk."""
TRAINING_SHARE = 0.25
"Of the memory, for the rows that an index is trained on."
TRAINING_COPIES = 1.75
"FAISS's residuals and reduced copies of them, the rows themselves included."
MAX_TRAINING_ROWS = 2_000_000
ROWS_PER_LIST = 50
"That train a centroid: FAISS warns below 39 and uses no more than 256."
UNIT_SHARE = 1 / 16
"Of the memory, for the codes of one work unit; while lists grow they take twice that."
MIN_UNIT_ROWS = 20_000
PART_SHARE = 1 / 3
"Of the memory, for merging a part of an index whose lists then stay on the disk."
RERANK_FACTOR = 10
"Candidates per wanted row whose vectors are read from the table."


@dataclass(frozen=True, kw_only=True)
class GallerySpec:
    """What is to be indexed, and within which limits."""

    rows: int
    dimension: int
    budget: float
    "Bytes that building or searching may take, the process included."
    target_recall: float
    "Recall@10 against exact search."
    effective_dimension: int | None = None
    "Leading directions that hold nearly all of the vectors' length; None where not known."
    workers: int = 0
    "Other processes that build units, on machines with as much memory for all of them together."
    rows_readable: bool = True
    "Whether single vectors can be read from the table while searching."
    p99_ms: float | None = None
    "Milliseconds within which 99 of 100 batches are to be answered; None: any."
    batch: int = 1
    "Queries of such a batch."
    build_seconds: float | None = None
    "Seconds that training and adding may take; None: any."
    selectivity: float = 1.0
    "Share of the rows that the filters of searches leave."


@dataclass(frozen=True, kw_only=True)
class IndexPlan:
    """How to build an index, what it will take, and why this one."""

    factory: str
    "As `faiss.index_factory` reads it."
    refine: Refine
    "table: candidates are scored again by the table's own vectors."
    on_disk: bool
    "Inverted lists stay on the disk and are mapped into memory."
    training_rows: int
    "0: nothing is trained."
    unit_rows: int
    "Rows of a work unit: built alone, then merged with the others."
    part_rows: int
    "Rows of a part of the index: more than one part where the lists stay on the disk."
    search_bytes: float
    build_bytes: float
    expected_recall: float
    "Recall@10 that is reached once the search parameters are tuned."
    reason: str

    @property
    def bytes(self) -> float:
        """The most that is in memory at any time."""
        return max(self.search_bytes, self.build_bytes)


def plan_index(gallery: GallerySpec) -> IndexPlan:
    """The most promising plan for a gallery, untried.

    Raises InputError, with the memory that would do, where no family fits the budget.
    """
    return candidate_plans(gallery)[0]


def candidate_plans(gallery: GallerySpec) -> list[IndexPlan]:
    """The plans that fit the budget: first those whose family is known to reach the recall, from
    the fastest to the slowest, then the others, the highest recall first.

    Raises InputError, with the memory that would do, where no family fits the budget.
    """
    plans = list(_plans(gallery))
    fitting = [plan for plan in plans if plan.bytes <= gallery.budget]
    if not fitting:
        least = min(plans, key=lambda plan: plan.bytes)
        raise InputError(
            f"{gallery.rows:,} rows of {gallery.dimension} dimensions take "
            f"{least.bytes / 1e9:.2f} GB at least, by {least.factory}, and the budget is "
            f"{gallery.budget / 1e9:.2f} GB; raise --memory-budget, or index the gallery in "
            "several indexes, by --split, --view or tables of their own"
        )
    reaching = [plan for plan in fitting if plan.expected_recall >= gallery.target_recall]
    others = [plan for plan in fitting if plan not in reaching]
    return reaching + sorted(others, key=lambda plan: -plan.expected_recall)


def plan_factory(gallery: GallerySpec, factory: str, refine: Refine = "none") -> IndexPlan:
    """The plan for a factory string of the user's. Its memory and recall are not estimated: 0."""
    lists = re.search(r"IVF(\d+)", factory)
    return IndexPlan(
        factory=factory,
        refine=refine,
        on_disk=False,
        training_rows=_training_rows(gallery, int(lists[1]) if lists else 0),
        unit_rows=max(MIN_UNIT_ROWS, int(gallery.budget * UNIT_SHARE / (4 * gallery.dimension))),
        part_rows=gallery.rows,
        search_bytes=0,
        build_bytes=0,
        expected_recall=0,
        reason="as given by --factory",
    )


def _plans(gallery: GallerySpec) -> Iterator[IndexPlan]:
    """The plans of all families that suit the gallery, the fastest first, whatever they take."""
    if gallery.rows <= EXACT_ROWS:
        yield _plan(EXACT, gallery)
    pays = (
        gallery.effective_dimension is not None
        and gallery.effective_dimension <= gallery.dimension // 2
    )
    for family in FAMILIES:
        readable = gallery.rows_readable or family.refine == "none"
        buildable = gallery.rows <= GRAPH_ROWS or not family.graph
        if readable and buildable and (pays or not family.reduces):
            yield _plan(family, gallery)


def _plan(family: IndexFamily, gallery: GallerySpec) -> IndexPlan:
    reduced = gallery.dimension
    if family.reduces and gallery.effective_dimension:
        reduced = gallery.effective_dimension
    lists = 0 if family is EXACT or family.graph else _lists(gallery)
    trained = 0 if family is EXACT else _training_rows(gallery, lists)
    code = family.code_bytes(reduced)
    fixed = (
        PROCESS_BYTES
        + lists * (4.0 * reduced + 64)
        + 4.0 * gallery.dimension * (reduced if family.reduces else 0)
    )
    codes, masks = gallery.rows * code, MASK_BYTES * gallery.rows
    unit = min(
        gallery.rows,
        max(MIN_UNIT_ROWS, int(gallery.budget * UNIT_SHARE / code / max(1, gallery.workers))),
    )
    if family.graph:
        unit = gallery.rows
    part = max(unit, int(gallery.budget * PART_SHARE / code)) if family.on_disk else gallery.rows
    merging = part * code if family.on_disk else family.merging * codes
    growing = max(1, gallery.workers) * (fixed + BLOCK_BYTES + 2 * unit * code)
    growing += PROCESS_BYTES if gallery.workers else 0
    projection = f"PCA{reduced}," if family.reduces else ""
    training = TRAINING_COPIES * 4.0 * trained * gallery.dimension
    return IndexPlan(
        factory=projection + factory_string(family, lists, reduced),
        refine=family.refine,
        on_disk=family.on_disk,
        training_rows=trained,
        unit_rows=unit,
        part_rows=part,
        search_bytes=fixed + masks + (0 if family.on_disk else codes),
        build_bytes=max(growing, fixed + BLOCK_BYTES + max(merging, training)),
        expected_recall=family.ceiling,
        reason=_reason(family, gallery, reduced, code),
    )


def _lists(gallery: GallerySpec) -> int:
    """About twice the root of the rows, as a power of two; at most as many as the memory can
    train.
    """
    most = max(1, _max_training_rows(gallery) // ROWS_PER_LIST)
    return int(2 ** min(round(math.log2(2 * math.sqrt(gallery.rows))), math.floor(math.log2(most))))


def _max_training_rows(gallery: GallerySpec) -> int:
    by_memory = int(gallery.budget * TRAINING_SHARE / (4 * gallery.dimension))
    return max(1, min(gallery.rows, by_memory, MAX_TRAINING_ROWS))


def _training_rows(gallery: GallerySpec, lists: int) -> int:
    """At least 16,384: codes and projections are trained on them as well."""
    return min(_max_training_rows(gallery), max(16_384, ROWS_PER_LIST * lists))


def _reason(family: IndexFamily, gallery: GallerySpec, reduced: int, code: float) -> str:
    kind = family.kind
    if family is EXACT:
        return f"{kind}: {gallery.rows:,} rows are few enough to compare each"
    if family.reduces:
        kind += f" of vectors reduced from {gallery.dimension} to {reduced} directions"
    if family.on_disk:
        kind += ", on the disk"
    if family.refine == "table":
        kind += ", the best candidates scored again by the table's vectors"
    return f"{kind}: {code:,.0f} bytes a row"
