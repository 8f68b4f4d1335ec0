"""The balance of an index's inverted lists, which rows that are added later may upset.

In: opened parts of an index. Out: the rows of each list, and a sentence where extending made the
lists so uneven that searches read many more codes. Shapes: L lists.
"""

from collections.abc import Sequence

import numpy as np

from pipeline.core.arrays import Ints
from pipeline.index.faiss_io import FAISS
from pipeline.index.part import IndexPart

UNEVEN = 1.5
"Growth of the imbalance, and so of the codes that a search reads, from which lists are named."
LONG = 4
"A list is called long from so many times the mean length on."
NAMED = 5
"Long lists that a sentence names."


def list_lengths(parts: Sequence[IndexPart]) -> Ints | None:
    """Rows in each list (L,), over the parts of one index; None where it has no lists."""
    total_L: Ints | None = None
    for part in parts:
        ivf = FAISS.try_extract_index_ivf(part.index)
        if ivf is None:
            return None
        lengths_L = np.array([ivf.invlists.list_size(n) for n in range(ivf.nlist)], np.int64)
        total_L = lengths_L if total_L is None else total_L + lengths_L
    return total_L


def imbalance(lengths_L: Ints) -> float:
    """Rows that share a row's list, on average over the rows, as a multiple of the mean length; 1:
    lists of equal length.
    """
    rows = float(lengths_L.sum())
    squares = float((lengths_L.astype(np.float64) ** 2).sum())
    return len(lengths_L) * squares / rows**2 if rows else 1.0


def lost_balance(before_L: Ints, after_L: Ints) -> str | None:
    """A sentence that names the lists which rows added later made long; None where the balance
    was kept.
    """
    earlier, now = imbalance(before_L), imbalance(after_L)
    if now < UNEVEN * earlier:
        return None
    mean = after_L.mean()
    long_L = np.flatnonzero((after_L > LONG * mean) & (before_L <= LONG * before_L.mean()))
    longest = long_L[np.argsort(-after_L[long_L], kind="stable")][:NAMED].tolist()
    named = ", ".join(f"{number} with {after_L[number]:,} rows" for number in longest)
    return (
        f"the lists lost their balance: {earlier:.2f} before the extension, {now:.2f} now (1: "
        f"equal lengths), {len(long_L)} lists are longer than {LONG} times the mean of {mean:,.0f}"
        f"{f', such as {named}' if named else ''}; searches read {now / earlier:.1f} times the "
        "codes; build the index again into another --out, which trains its lists on all rows"
    )
