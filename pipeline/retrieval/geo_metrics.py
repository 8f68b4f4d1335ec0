"""Distance errors on the ground: positions of queries and of their best answers in, metres and
SDM@K out.

Intervals resample locations, as those of recall do. NumPy only, no I/O. Positions are (latitude,
longitude) in degrees, WGS84.
Shapes: Q queries, K answers of each, 2 = latitude and longitude.
"""

import numpy as np

from pipeline.core.arrays import Doubles, Strings
from pipeline.core.geo import haversine_m
from pipeline.retrieval.bootstrap import confidence_intervals, quantile_intervals

WITHIN_M = (1, 5, 25, 50, 100)
QUANTILES = {"distance_median_m": 0.5, "distance_p90_m": 0.9}
WITH_INTERVALS = ("within_1m", "within_5m", "within_25m", *QUANTILES)
"Measures that have a 95 % interval beside."
SDM_K = (1, 3, 5, 10)  # as DenseUAV's evaluation prints
SDM_SCALE = 5e3  # per degree, from the same source: 1e-4 degrees, about 11 m, cost 40 %


def spatial_distance_metric(query_Q2: Doubles, answers_QK2: Doubles) -> Doubles:
    """SDM@K of each query (Q,), K = answers_QK2.shape[1]: 1 if all K answers lie at the query's
    position, towards 0 with distance.

    The i-th answer (from 1) weighs K - i + 1 and is worth exp(-s d), with d the Euclidean distance
    in degrees and s = 5000; SDM@K is the weighted mean. Source: Dai et al., Vision-Based UAV
    Self-Positioning in Low-Altitude Urban Environments (arXiv 2201.09201), and its
    evaluateDistance.py, which computes in float32 where this uses float64.
    """
    degrees_QK = np.linalg.norm(answers_QK2 - query_Q2[:, None], axis=2)
    weight_K = np.arange(degrees_QK.shape[1], 0, -1, dtype=np.float64)
    return np.asarray((np.exp(-SDM_SCALE * degrees_QK) * weight_K).sum(axis=1) / weight_K.sum())


def distance_metrics(
    query_Q2: Doubles, answers_QK2: Doubles, locations_Q: Strings
) -> dict[str, float | int | None]:
    """Distance error of the best answer with intervals, and SDM@K, over the queries of known
    position. All None if no query's position is known, or some answer's is not: with a partly
    tagged gallery, a network that answers with tagged rows would look better than it is."""
    known_Q = ~np.isnan(query_Q2).any(axis=1)
    measurable = bool(known_Q.any() and answers_QK2.shape[1] and not np.isnan(answers_QK2).any())
    query_Q2, answers_QK2 = query_Q2[known_Q], answers_QK2[known_Q]
    found: dict[str, float | int | None] = {"geo_queries": int(known_Q.sum()) if measurable else 0}
    error_Q = haversine_m(query_Q2, answers_QK2[:, 0]) if measurable else np.empty(0)
    for name, share in QUANTILES.items():
        found[name] = float(np.quantile(error_Q, share)) if measurable else None
    for metres in WITHIN_M:
        found[f"within_{metres}m"] = float(np.mean(error_Q <= metres)) if measurable else None
    found |= (
        _intervals(error_Q, locations_Q[known_Q])
        if measurable
        else {f"{name}_{end}": None for name in WITH_INTERVALS for end in ("low", "high")}
    )
    for k in SDM_K:
        enough = measurable and answers_QK2.shape[1] >= k
        found[f"sdm{k}"] = (
            float(spatial_distance_metric(query_Q2, answers_QK2[:, :k]).mean()) if enough else None
        )
    return found


def _intervals(error_Q: Doubles, locations_Q: Strings) -> dict[str, float | int | None]:
    within = [metres for metres in WITHIN_M if f"within_{metres}m" in WITH_INTERVALS]
    hits_QM = np.stack([error_Q <= metres for metres in within], axis=1).astype(np.float64)
    bounds_2M = np.concatenate(
        [
            confidence_intervals(hits_QM, locations_Q),
            quantile_intervals(error_Q, locations_Q, list(QUANTILES.values())),
        ],
        axis=1,
    )
    return {
        f"{name}_{end}": float(value)
        for end, bounds_M in zip(("low", "high"), bounds_2M, strict=True)
        for name, value in zip(WITH_INTERVALS, bounds_M, strict=True)
    }
