"""Distance errors on the ground: positions of queries and of their best answers in, metres and
SDM@K out.

NumPy only, no I/O. Positions are (latitude, longitude) in degrees, WGS84.
Shapes: Q queries, K answers of each, 2 = latitude and longitude.
"""

import numpy as np

from pipeline.core.arrays import Doubles
from pipeline.core.geo import haversine_m

WITHIN_M = (25, 50, 100)
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


def distance_metrics(query_Q2: Doubles, answers_QK2: Doubles) -> dict[str, float | int | None]:
    """Distance error of the best answer and SDM@K, over the queries of known position. All None if
    no query's position is known, or some answer's is not: with a partly tagged gallery, a network
    that answers with tagged rows would look better than it is."""
    known_Q = ~np.isnan(query_Q2).any(axis=1)
    measurable = bool(known_Q.any() and answers_QK2.shape[1] and not np.isnan(answers_QK2).any())
    query_Q2, answers_QK2 = query_Q2[known_Q], answers_QK2[known_Q]
    found: dict[str, float | int | None] = {"geo_queries": int(known_Q.sum()) if measurable else 0}
    error_Q = haversine_m(query_Q2, answers_QK2[:, 0]) if measurable else np.empty(0)
    found["distance_median_m"] = float(np.median(error_Q)) if measurable else None
    for metres in WITHIN_M:
        found[f"within_{metres}m"] = float(np.mean(error_Q <= metres)) if measurable else None
    for k in SDM_K:
        enough = measurable and answers_QK2.shape[1] >= k
        found[f"sdm{k}"] = (
            float(spatial_distance_metric(query_Q2, answers_QK2[:, :k]).mean()) if enough else None
        )
    return found
