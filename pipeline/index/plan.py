"""Chooses the FAISS index of a gallery: rows, dimension, memory and wanted recall in, a factory
string with its reason out. A pure function.

FAMILIES are ordered from the fastest to the slowest, as `benchmarks/index.py` measures them
(docs/results.md). The first that fits the memory and is known to reach the recall is chosen; where
none reaches it, the one that comes nearest.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from pipeline.core.errors import InputError

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
MERGE_FACTOR = 1.3
"Multiple of the codes that merging them and reading them back took, with lists of 8-bit codes."
MAX_TRAINING_ROWS = 2_000_000
ROWS_PER_LIST = 50
"That train a centroid: FAISS warns below 39 and uses no more than 256."
UNIT_SHARE = 1 / 16
"Of the memory, for the codes of one work unit; while lists grow they take twice that."
MIN_UNIT_ROWS = 20_000
PART_SHARE = 1 / 3
"Of the memory, for merging a part of an index whose lists then stay on the disk."
SUBQUANTISER_DIM = 8
"Dimensions of a 4-bit subquantiser: 256 subquantisers at 2,048 dimensions."
RERANK_FACTOR = 10
"Candidates per wanted row whose vectors are read from the table."
Refine = Literal["none", "table"]


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


@dataclass(frozen=True, kw_only=True)
class _IndexFamily:
    """A kind of index."""

    name: str
    form: str
    "Factory string with {lists} and {pieces}, the subquantisers."
    ceiling: float
    "Recall@10 that the most thorough search reaches: what quantisation leaves."
    refine: Refine = "none"
    on_disk: bool = False
    graph: bool = False
    "Built in one piece, for FAISS cannot merge graphs."
    merging: float = MERGE_FACTOR
    "Memory of its codes while units are merged, as a multiple of the codes: appended ones double."
    reduces: bool = False
    "Whether it is used behind a projection onto the leading directions, or without one."

    def code_bytes(self, dimension: int) -> float:
        """Size of one row's code with its id or its links."""
        return {
            "Flat": 4.0 * dimension,
            "HNSW32,SQ8": dimension + 4.0 * 2 * 32 + 24,
            "SQ8": dimension + 8.0,
            "SQfp16": 2 * dimension + 8.0,
            "PQfs": dimension / (2 * SUBQUANTISER_DIM) + 8,
            "RaBitQ": dimension / 8 + 16,
            "RaBitQ4": dimension / 2 + 24,
        }[self.name]


FAMILIES = (
    _IndexFamily(name="SQ8", form="IVF{lists},SQ8", ceiling=0.985, refine="table", reduces=True),
    _IndexFamily(name="HNSW32,SQ8", form="HNSW32,SQ8", ceiling=0.985, graph=True, merging=2),
    _IndexFamily(
        name="PQfs", form="IVF{lists},PQ{pieces}x4fs", ceiling=0.98, refine="table", merging=2
    ),
    _IndexFamily(name="SQ8", form="IVF{lists},SQ8", ceiling=0.985),
    _IndexFamily(name="SQfp16", form="IVF{lists},SQfp16", ceiling=0.999),
    _IndexFamily(
        name="RaBitQ", form="IVF{lists},RaBitQ", ceiling=0.97, refine="table", on_disk=True
    ),
    _IndexFamily(name="RaBitQ4", form="IVF{lists},RaBitQ4", ceiling=0.9),
    _IndexFamily(name="SQ8", form="IVF{lists},SQ8", ceiling=0.985, on_disk=True),
)
EXACT = _IndexFamily(name="Flat", form="Flat", ceiling=1.0, merging=2)


def plan_index(gallery: GallerySpec) -> IndexPlan:
    """The plan for a gallery.

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
    for plan in fitting:
        if plan.expected_recall >= gallery.target_recall:
            return plan
    return max(fitting, key=lambda plan: plan.expected_recall)


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


def _plan(family: _IndexFamily, gallery: GallerySpec) -> IndexPlan:
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


def factory_string(family: _IndexFamily, lists: int, dimension: int) -> str:
    """A family's factory string. The number of subquantisers must divide the dimension."""
    most = max(1, dimension // SUBQUANTISER_DIM)
    pieces = next(count for count in range(most, 0, -1) if dimension % count == 0)
    return family.form.format(lists=lists, pieces=pieces)


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


def _reason(family: _IndexFamily, gallery: GallerySpec, reduced: int, code: float) -> str:
    kind = {
        "Flat": f"exact search: {gallery.rows:,} rows are few enough to compare each",
        "HNSW32,SQ8": "a graph over 8-bit codes",
        "SQfp16": "lists of 16-bit numbers",
        "SQ8": "lists of 8-bit codes",
        "PQfs": "lists of 4-bit product codes",
        "RaBitQ": "lists of one-bit codes",
        "RaBitQ4": "lists of four-bit codes",
    }[family.name]
    if family is EXACT:
        return kind
    if family.reduces:
        kind += f" of vectors reduced from {gallery.dimension} to {reduced} directions"
    if family.on_disk:
        kind += ", on the disk"
    if family.refine == "table":
        kind += ", the best candidates scored again by the table's vectors"
    return f"{kind}: {code:,.0f} bytes a row"
