"""Measures of retrieval: ranks of the true matches in, Recall@K and average precision out. NumPy
only, no I/O.

Ranks are 1-based: the row that scores highest has rank 1. Ties are broken against the query
(pessimistically): a true match ranks behind every other gallery row of equal score, so a network
that gives all images one vector finds nothing. A query without a true match has no rank (0 in
arrays here, null in files), counts as zero in every mean and stays in the denominator:
University-1652's official evaluate_gpu.py (github.com/layumi/University1652-Baseline) skips it in
its sums and divides by the number of all queries. All means are fractions from 0 to 1.

Shapes: Q queries, P true matches of all queries together. `owner_P` is the query that each match
belongs to; both arrays are ordered by query, then by rank.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.core.arrays import Doubles, Ints

Protocol = Literal["full", "queried-only"]
"""full: the official one, the whole gallery with its distractors. queried-only: gallery rows of
queried locations alone."""


@dataclass(frozen=True, kw_only=True)
class RetrievalMetrics:
    """The measures of one task; fractions from 0 to 1."""

    r1: float
    r5: float
    r10: float
    r1p: float
    "Recall at the top 1 %, by the field's definition: see `one_percent_k`."
    ap: float
    "Mean average precision."


def first_match_ranks(ranks_P: Ints, owner_P: Ints, queries: int) -> Ints:
    """Best rank of a true match, for each query (Q,); 0 if it has none."""
    best_Q = np.full(queries, np.iinfo(np.int64).max, np.int64)
    np.minimum.at(best_Q, owner_P, ranks_P)
    best_Q[best_Q == np.iinfo(np.int64).max] = 0
    return best_Q


def hits_at(k: int, first_Q: Ints) -> Doubles:
    """1 where a query has a true match among the first K, else 0 (Q,). `first_Q` from
    `first_match_ranks`.
    """
    return np.asarray((first_Q > 0) & (first_Q <= k), np.float64)


def recall_at(k: int, first_Q: Ints) -> float:
    """Recall@K: the share of queries with a true match among the first K."""
    return float(np.mean(hits_at(k, first_Q))) if len(first_Q) else 0.0


def one_percent_k(gallery: int) -> int:
    """The K of the field's "top 1 %": `CMC[round(0.01 * N)]`, whose index starts at 0; R@11 of 951,
    R@515 of 51,355.

    Python's `round` goes to the even neighbour at .5, and so does the official code: R@1 of 50, R@3
    of 150 and of 250.
    """
    return round(0.01 * gallery) + 1


def average_precisions(ranks_P: Ints, owner_P: Ints, queries: int) -> Doubles:
    """Average precision of each query (Q,): the area under its precision-recall curve by
    trapezoids.

    The i-th match (from 0) at rank r (from 0) adds `((i/r if r else 1) + (i+1)/(r+1)) / 2`; AP is
    the mean over the matches. One match at 1-based rank k > 1 thus gives 1/(2k), not 1/k.
    """
    count_Q = np.bincount(owner_P, minlength=queries)
    begin_Q = np.cumsum(count_Q) - count_Q
    i_P = np.arange(len(ranks_P)) - begin_Q[owner_P]
    r_P = ranks_P - 1
    before_P = np.where(r_P > 0, i_P / np.maximum(r_P, 1), 1.0)
    area_P = (before_P + (i_P + 1) / (r_P + 1)) / 2
    total_Q = np.bincount(owner_P, weights=area_P, minlength=queries)
    return np.asarray(total_Q / np.maximum(count_Q, 1), np.float64)


def chance_recall(matches_Q: Ints, gallery: int) -> float:
    """R@1 of a random ranking: the share of the gallery that matches, averaged over the queries."""
    return float(np.mean(matches_Q / gallery)) if len(matches_Q) and gallery else 0.0


def per_query_values(first_Q: Ints, ap_Q: Doubles, gallery: int) -> Doubles:
    """The values whose means `summarise` takes: hits at 1, 5, 10 and the top 1 %, and average
    precision (Q, 5).
    """
    return np.stack(
        [*(hits_at(k, first_Q) for k in (1, 5, 10, one_percent_k(gallery))), ap_Q], axis=1
    )


def summarise(first_Q: Ints, ap_Q: Doubles, gallery: int) -> RetrievalMetrics:
    """The measures of one task from its queries' first ranks and average precisions."""
    return RetrievalMetrics(
        r1=recall_at(1, first_Q),
        r5=recall_at(5, first_Q),
        r10=recall_at(10, first_Q),
        r1p=recall_at(one_percent_k(gallery), first_Q),
        ap=float(np.mean(ap_Q)) if len(ap_Q) else 0.0,
    )
