"""The kinds of FAISS index that the planner knows, ordered from the fastest to the slowest.

The order is that of `benchmarks/index.py` (docs/results.md); which one is taken is decided by a
trial on the gallery's own vectors (`trial.py`), since it depends on how the neighbours lie.
"""

from dataclasses import dataclass, replace
from typing import Literal

SUBQUANTISER_DIM = 8
"Dimensions of a 4-bit subquantiser: 256 subquantisers at 2,048 dimensions."
GRAPH_BYTES = 4.0 * 2 * 32 + 24
"Links of a row of a graph: 64 on its lowest level, fewer above, and its level."
MERGE_FACTOR = 1.3
"Multiple of the codes that merging them and reading them back took, with lists of 8-bit codes."
Refine = Literal["none", "table"]


@dataclass(frozen=True, kw_only=True)
class IndexFamily:
    """A kind of index."""

    form: str
    "Factory string with {lists} and {pieces}, the subquantisers."
    kind: str
    "What it is, in words."
    bits: float
    "Of a code, for each dimension."
    extra_bytes: float = 8.0
    "Of a row besides its code: its id, factors of its code, or its links."
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
        return self.bits * dimension / 8 + self.extra_bytes


LISTS_OF_BYTES = IndexFamily(
    form="IVF{lists},SQ8", kind="lists of 8-bit codes", bits=8, ceiling=0.985
)
LISTS_OF_BITS = IndexFamily(
    form="IVF{lists},RaBitQ",
    kind="lists of one-bit codes",
    bits=1,
    extra_bytes=16,
    ceiling=0.97,
    refine="table",
)
GRAPH = IndexFamily(
    form="HNSW32,SQ8",
    kind="a graph over 8-bit codes",
    bits=8,
    extra_bytes=GRAPH_BYTES,
    ceiling=0.985,
    graph=True,
    merging=2,
)
FAMILIES = (
    replace(LISTS_OF_BYTES, refine="table", reduces=True),
    GRAPH,
    LISTS_OF_BYTES,
    LISTS_OF_BITS,
    IndexFamily(
        form="IVF{lists},PQ{pieces}x4fs",
        kind="lists of 4-bit product codes",
        bits=4 / SUBQUANTISER_DIM,
        ceiling=0.98,
        refine="table",
        merging=2,
    ),
    IndexFamily(form="IVF{lists},SQfp16", kind="lists of 16-bit numbers", bits=16, ceiling=0.999),
    replace(GRAPH, ceiling=0.99, refine="table"),
    replace(LISTS_OF_BITS, on_disk=True),
    IndexFamily(
        form="IVF{lists},RaBitQ4",
        kind="lists of four-bit codes",
        bits=4,
        extra_bytes=24,
        ceiling=0.9,
    ),
    replace(LISTS_OF_BYTES, on_disk=True),
)
EXACT = IndexFamily(
    form="Flat", kind="exact search", bits=32, extra_bytes=0, ceiling=1.0, merging=2
)


def factory_string(family: IndexFamily, lists: int, dimension: int) -> str:
    """A family's factory string. The number of subquantisers must divide the dimension."""
    most = max(1, dimension // SUBQUANTISER_DIM)
    pieces = next(count for count in range(most, 0, -1) if dimension % count == 0)
    return family.form.format(lists=lists, pieces=pieces)
