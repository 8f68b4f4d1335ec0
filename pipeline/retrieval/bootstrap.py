"""Bootstrap: per-query values with their locations in, 95 % intervals of their means and paired
differences of two runs out.

Images of one location resemble each other, so locations are resampled, not queries (a cluster
bootstrap: Davison and Hinkley, Bootstrap Methods and their Application, 1997, section 3.8). NumPy
only, seeded, no I/O. Shapes: Q queries, L locations, M measures, S samples.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.core.arrays import Doubles, Ints, Strings
from pipeline.retrieval import metrics

BOOTSTRAP_SAMPLES = 2_000
BOOTSTRAP_SEED = 0
CONFIDENCE_LEVEL = 0.95
WEIGHTS_PER_BLOCK = 4_000_000  # drawn at a time: 32 MB


@dataclass(frozen=True, kw_only=True)
class Difference:
    """One run against another on the same queries."""

    mean: float
    "The run's mean minus the baseline's."
    low: float
    high: float
    p: float
    """Two-sided: the share of resampled differences on the other side of zero, doubled; at least
    2 / (samples + 1)."""


def resampled_means(
    values_QM: Doubles,
    locations_Q: Strings,
    samples: int = BOOTSTRAP_SAMPLES,
    seed: int = BOOTSTRAP_SEED,
) -> Doubles:
    """Means (S, M) over queries of locations drawn with replacement, as many as there are.

    The draws depend on the number of locations and the seed alone, so two runs on the same queries
    are resampled alike.
    """
    names, location_Q = np.unique(locations_Q, return_inverse=True)
    count_L = np.bincount(location_Q).astype(np.float64)
    total_LM = np.stack(
        [np.bincount(location_Q, weights=column_Q) for column_Q in values_QM.T], axis=1
    )
    return np.concatenate(
        [
            (weight_SL @ total_LM) / (weight_SL @ count_L)[:, None]
            for weight_SL in _draws(len(names), len(names), samples, seed)
        ]
    )


def _draws(locations: int, width: int, samples: int, seed: int) -> Iterator[Ints]:
    """How often each location is drawn (S, L), in blocks that `width` columns of them fit."""
    rng, step = np.random.default_rng(seed), max(1, WEIGHTS_PER_BLOCK // width)
    for first in range(0, samples, step):
        share_L = np.full(locations, 1 / locations)
        yield rng.multinomial(locations, share_L, min(step, samples - first))


def quantile_intervals(
    values_Q: Doubles,
    locations_Q: Strings,
    shares: Sequence[float],
    samples: int = BOOTSTRAP_SAMPLES,
    seed: int = BOOTSTRAP_SEED,
) -> Doubles:
    """The 95 % percentile interval of each quantile of the values, (2, M): low, high; locations are
    drawn as for means. Q >= 1."""
    names, location_Q = np.unique(locations_Q, return_inverse=True)
    order_Q = np.argsort(values_Q, kind="stable")
    sorted_Q, found = values_Q[order_Q], []
    for weight_SL in _draws(len(names), len(values_Q), samples, seed):
        reached_SQ = np.cumsum(weight_SL[:, location_Q[order_Q]], axis=1)
        at_SM = [(reached_SQ < share * reached_SQ[:, -1:]).sum(axis=1) for share in shares]
        found.append(sorted_Q[np.stack(at_SM, axis=1)])
    tails = [(1 - CONFIDENCE_LEVEL) / 2, (1 + CONFIDENCE_LEVEL) / 2]
    return np.asarray(np.quantile(np.concatenate(found), tails, axis=0))


def confidence_intervals(
    values_QM: Doubles,
    locations_Q: Strings,
    samples: int = BOOTSTRAP_SAMPLES,
    seed: int = BOOTSTRAP_SEED,
) -> Doubles:
    """The 95 % percentile interval of each measure's mean, (2, M): low, high. NaN without
    queries."""
    if not len(values_QM):
        return np.full((2, values_QM.shape[1]), np.nan)
    means_SM = resampled_means(values_QM, locations_Q, samples, seed)
    return np.quantile(means_SM, [(1 - CONFIDENCE_LEVEL) / 2, (1 + CONFIDENCE_LEVEL) / 2], axis=0)


def paired_difference(
    run_Q: Doubles,
    baseline_Q: Doubles,
    locations_Q: Strings,
    samples: int = BOOTSTRAP_SAMPLES,
    seed: int = BOOTSTRAP_SEED,
) -> Difference:
    """The difference of two runs' means over the same queries, in the same order."""
    change_Q1 = (run_Q - baseline_Q)[:, None]
    means_S = resampled_means(change_Q1, locations_Q, samples, seed)[:, 0]
    low, high = np.quantile(means_S, [(1 - CONFIDENCE_LEVEL) / 2, (1 + CONFIDENCE_LEVEL) / 2])
    beyond = min(np.count_nonzero(means_S <= 0), np.count_nonzero(means_S >= 0))
    return Difference(
        mean=float(change_Q1.mean()),
        low=float(low),
        high=float(high),
        p=min(1.0, 2 * (beyond + 1) / (samples + 1)),
    )


def metrics_with_intervals(first_Q: Ints, ap_Q: Doubles, locations_Q: Strings) -> dict[str, Any]:
    """R@1, R@5 and AP of some queries, R@1 and AP with 95 % intervals; the numbers of queries and
    of their locations.
    """
    hit_Q = metrics.hits_at(1, first_Q)
    low, high = confidence_intervals(np.stack([hit_Q, ap_Q], axis=1), locations_Q)
    return {
        "queries": len(first_Q),
        "locations": len(np.unique(locations_Q)),
        "r1": float(hit_Q.mean()),
        "r5": metrics.recall_at(5, first_Q),
        "ap": float(ap_Q.mean()),
        "r1_low": float(low[0]),
        "r1_high": float(high[0]),
        "ap_low": float(low[1]),
        "ap_high": float(high[1]),
    }
