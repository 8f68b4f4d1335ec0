"""Candidates of one photo -> the position that they agree on.

In: scores, locations and positions of the hits of a search, best first. Out: the group of
candidates with the most support, its position, and figures that tell how far it stands out from all
other candidates. NumPy only, no I/O.
Shapes: K candidates, N candidates of the group, 2 = latitude and longitude in degrees (NaN where
unknown), 3 = metres from the earth's centre.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Doubles, Mask
from pipeline.core.geo import haversine_m, on_sphere

WEISZFELD_STEPS = 60
"""The error halves every few iterations: 60 leave far less than a metre on areas of kilometres."""

MIN_WEIGHT = 1e-6
"The last candidate has weight 0, which would leave a group of that candidate alone without weight."

SAME_POINT_M = 1e-3
"A millimetre: positions in degrees with seven decimals are not finer."


@dataclass(frozen=True, kw_only=True)
class Consensus:
    """The group of agreeing candidates with the most support."""

    members_K: Mask
    "Which candidates belong to the group."
    leader: int
    "The best-scored member."
    lat: float | None
    "Latitude of the group in degrees; None where no member's position is known."
    lon: float | None
    spread_m: float
    "Weighted root mean square distance of the members from the group's position."
    scale: float
    "Of the finest member with a known position: its side over that of the gallery's finest level."
    best_other_score: float
    "The best score of a candidate outside the group; where there is none, the last score."


def support_weights(scores_K: Doubles) -> Doubles:
    """Weight of each candidate, 0 to 1: its score above the last one's as a fraction of the best
    one's, squared.

    The last of some ten candidates has the score that the gallery reaches by chance. Squared, so
    that many candidates little above that level, close together by chance, do not outweigh one that
    stands out. Equal scores get equal weights.
    """
    level, best = scores_K.min(), scores_K.max()
    if best <= level:
        return np.ones_like(scores_K)
    return np.asarray(((scores_K - level) / (best - level)) ** 2)


def agreement(locations_K: Sequence[str], positions_K2: Doubles, radius_K: Doubles) -> Mask:
    """Which pairs of candidates agree (K, K): those of one location, and those that are at most the
    larger of their radii apart, metres."""
    names_K = np.asarray(locations_K, dtype=np.str_)
    radius_KK = np.maximum(radius_K[:, None], radius_K[None])
    near_KK = haversine_m(positions_K2[:, None], positions_K2[None]) <= radius_KK  # NaN: False
    return np.asarray((names_K[:, None] == names_K[None]) | near_KK)


def find_consensus(
    scores_K: Doubles,
    locations_K: Sequence[str],
    positions_K2: Doubles,
    agreement_radius_m: float,
    scale_K: Doubles | None = None,
) -> Consensus:
    """The candidate with the highest sum of weights around it, and all that agree with it; K >= 1,
    best first.

    `scale_K`: how many times the side of the gallery's finest level a candidate's ground has; by
    default all are of one level. A coarse candidate agrees with finer ones on its ground, and its
    own middle says less of where the photo is.

    The position is the group's weighted geometric median: it stays at the best candidate until the
    others together outweigh it, so that one unlike neighbour moves nothing, while a ring of
    overlapping images draws it to their middle.
    """
    weight_K = support_weights(scores_K)
    if scale_K is None:
        scale_K = np.ones_like(scores_K)
    agree_KK = agreement(locations_K, positions_K2, agreement_radius_m * scale_K)
    members_K = agree_KK[int(np.argmax(agree_KK @ weight_K))]
    others_K = scores_K[~members_K]
    known_K = members_K & ~np.isnan(positions_K2).any(axis=1)
    lat = lon = None
    spread_m = 0.0
    if known_K.any():
        weight_N = np.maximum(weight_K[known_K], MIN_WEIGHT) / scale_K[known_K]
        lat, lon = geometric_median(positions_K2[known_K], weight_N)
        distance_N = haversine_m(positions_K2[known_K], np.array([lat, lon]))
        spread_m = float(np.sqrt(np.average(distance_N**2, weights=weight_N)))
    return Consensus(
        members_K=members_K,
        leader=int(np.argmax(members_K)),
        lat=lat,
        lon=lon,
        spread_m=spread_m,
        scale=float(scale_K[known_K if known_K.any() else members_K].min()),
        best_other_score=float(others_K.max() if len(others_K) else scores_K.min()),
    )


def geometric_median(positions_N2: Doubles, weight_N: Doubles) -> tuple[float, float]:
    """Latitude and longitude of the point with the least sum of weighted distances; N >= 1.

    Exactly one of the given positions where its weight is at least the pull of all others; else
    found by Weiszfeld's iteration (Vardi and Zhang, The multivariate L1-median and associated data
    depth, 2000, theorem 1).
    """
    points_N3 = on_sphere(positions_N2)
    apart_NN3 = points_N3[None] - points_N3[:, None]
    distance_NN = np.linalg.norm(apart_NN3, axis=2)
    same_NN = distance_NN < SAME_POINT_M
    pull_NN = np.where(same_NN, 0, weight_N / np.where(same_NN, 1, distance_NN))
    pull_N = np.linalg.norm((pull_NN[:, :, None] * apart_NN3).sum(axis=1), axis=1)
    holds_N = same_NN @ weight_N >= pull_N
    if holds_N.any():
        return float(positions_N2[holds_N][0, 0]), float(positions_N2[holds_N][0, 1])
    middle_3 = np.average(points_N3, axis=0, weights=weight_N)
    for _ in range(WEISZFELD_STEPS):
        share_N = weight_N / np.maximum(np.linalg.norm(points_N3 - middle_3, axis=1), 1e-6)
        middle_3 = np.average(points_N3, axis=0, weights=share_N)
    lat = np.degrees(np.arctan2(middle_3[2], np.hypot(middle_3[0], middle_3[1])))
    return float(lat), float(np.degrees(np.arctan2(middle_3[1], middle_3[0])))
