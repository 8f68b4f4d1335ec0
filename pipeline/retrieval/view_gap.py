"""The gap between two views in the embedding: vectors of both in, statistics and the points of a
scatter plot out. NumPy only, no I/O.

Only places that both views show are compared: otherwise a gallery's distractors would pass for a
property of their view. The sample is evenly spaced and the projection a principal component
analysis, so the same features give the same points.

Shapes: N chosen rows of the queries' view, M of the gallery's, S of both, L places, D dimensions.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.core.arrays import Doubles, Floats, Ints, Strings
from pipeline.retrieval.subsets import RowSample, evenly_spaced

MAX_ROWS_PER_VIEW = 400
"More points than a picture can show apart, and an eigenproblem of half a second."
MAX_JOINED_PAIRS = 40
"True pairs that the picture joins with lines."
PERCENTILES = (5, 95)
DECIMALS = 5  # of the numbers written: below the error of float32 sums


@dataclass(frozen=True, kw_only=True)
class Projection:
    """Rows of two views in two dimensions."""

    points_S2: Doubles
    """The first N rows are the queries', the others the gallery's; the origin lies midway between
    the views' means."""
    shares: tuple[float, float]
    "Share of the variance along either axis, with equal weight of both views."


def choose_common_rows(
    query_locations: Strings, gallery_locations: Strings, most: int = MAX_ROWS_PER_VIEW
) -> tuple[Ints, Ints]:
    """Rows of the queries and of the gallery: at most `most` of each, of as many common places as
    that allows, evenly spaced and equally many of each place.
    """
    places = np.intersect1d(query_locations, gallery_locations)
    places_L = places[evenly_spaced(len(places), most)]
    each = max(1, most // max(len(places_L), 1))
    chosen = []
    for locations in (query_locations, gallery_locations):
        order = np.argsort(locations, kind="stable")
        bounds = [
            np.searchsorted(locations[order], places_L, side=side) for side in ("left", "right")
        ]
        rows = [
            order[begin:end][evenly_spaced(end - begin, each)]
            for begin, end in zip(*bounds, strict=True)
        ]
        chosen.append(np.concatenate([np.empty(0, np.int64), *rows]))
    return chosen[0], chosen[1]


def project_pca(query_ND: Floats, gallery_MD: Floats) -> Projection:
    """Project onto the two directions of greatest variance around the midpoint of the views' means;
    either view has half the weight.
    """
    both_SD = np.concatenate([query_ND, gallery_MD]).astype(np.float64)
    both_SD -= (query_ND.mean(0, dtype=np.float64) + gallery_MD.mean(0, dtype=np.float64)) / 2
    weight_S1 = np.sqrt(
        np.repeat([1 / len(query_ND), 1 / len(gallery_MD)], [len(query_ND), len(gallery_MD)])
    )[:, None]
    weighted_SD = both_SD * weight_S1
    gram_SS = weighted_SD @ weighted_SD.T  # S x S: there are fewer rows than dimensions
    values, vectors_SS = np.linalg.eigh(gram_SS)
    total = float(np.trace(gram_SS)) or 1.0
    axes_D2 = weighted_SD.T @ vectors_SS[:, -2:][:, ::-1]
    length_2 = np.linalg.norm(axes_D2, axis=0)
    axes_D2 /= np.where(length_2 > 1e-9, length_2, np.inf)  # no variance: all points lie at 0
    # An eigenvector's sign is arbitrary: its largest component becomes positive.
    largest_12 = np.take_along_axis(axes_D2, np.abs(axes_D2).argmax(0)[None], 0)
    axes_D2 *= np.where(largest_12 < 0, -1, 1)
    shares = np.maximum(values[::-1][:2], 0) / total
    return Projection(points_S2=both_SD @ axes_D2, shares=(float(shares[0]), float(shares[1])))


def mean_distance(query_ND: Floats, gallery_MD: Floats) -> float:
    """Distance of the views' means in units of a view's spread: the images' root mean square
    distance from their own view's mean, with equal weight of both views. jobs/training/probes.py
    measures the same on the feature maps of training images."""
    means = [rows.mean(0, dtype=np.float64) for rows in (query_ND, gallery_MD)]
    squares = [
        ((rows - mean) ** 2).sum(1).mean()
        for rows, mean in zip((query_ND, gallery_MD), means, strict=True)
    ]
    return float(np.linalg.norm(means[1] - means[0]) / max(np.sqrt(np.mean(squares)), 1e-12))


def cosine_summary(scores: Floats) -> dict[str, float | int]:
    """Mean, 5th and 95th percentile of the cosines of some pairs."""
    low, high = np.percentile(scores, PERCENTILES) if len(scores) else (np.nan, np.nan)
    mean = scores.mean(dtype=np.float64) if len(scores) else np.nan
    return {"pairs": len(scores)} | {
        name: round(float(value), DECIMALS)
        for name, value in (("mean", mean), ("low", low), ("high", high))
    }


def describe_gap(query: RowSample, gallery: RowSample) -> dict[str, Any]:
    """The statistics of the gap, the points, and the index pairs of points to join: one true pair
    for each of some evenly spaced places.

    Raises ValueError if the rows show one place: then there are no other pairs to compare with.
    """
    same_NM = query.locations_N[:, None] == gallery.locations_N
    if same_NM.all():
        raise ValueError("the rows show one place, expected several; choose rows of more places")
    scores_NM = query.vectors_ND @ gallery.vectors_ND.T
    projection = project_pca(query.vectors_ND, gallery.vectors_ND)
    named = [
        {"key": key, "location": place, "side": side}
        for side, rows in (("query", query), ("gallery", gallery))
        for key, place in zip(rows.keys_N.tolist(), rows.locations_N.tolist(), strict=True)
    ]
    places, first_L = np.unique(query.locations_N, return_index=True)
    joined = [
        [int(first_L[i]), len(query.keys_N) + int(np.argmax(same_NM[first_L[i]]))]
        for i in evenly_spaced(len(places), MAX_JOINED_PAIRS)
    ]
    return {
        "shares": [round(share, DECIMALS) for share in projection.shares],
        "distance": round(mean_distance(query.vectors_ND, gallery.vectors_ND), DECIMALS),
        "true": cosine_summary(scores_NM[same_NM]),
        "other": cosine_summary(scores_NM[~same_NM]),
        "points": [
            name | {"x": round(x, DECIMALS), "y": round(y, DECIMALS)}
            for name, (x, y) in zip(named, projection.points_S2.tolist(), strict=True)
        ],
        "joined": joined,
    }
