"""Candidates of one photo -> the place that they agree on: who stands together on the map, how
strongly, and where.

In: scores, locations and positions of what a search found, best first. Out: the best-supported
place with its members, and numbers that tell how far it stands out from everywhere else. NumPy
only, no I/O. Shapes: K candidates, 2 = latitude and longitude in degrees (NaN where unknown), 3 =
metres from the earth's centre.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.core.arrays import Doubles
from pipeline.core.geo import haversine_m, on_sphere

Flags = npt.NDArray[np.bool_]
# of Weiszfeld's iteration, which halves the error every few: far below a metre on areas of
# kilometres
WEISZFELD_STEPS = 60


@dataclass(frozen=True, kw_only=True)
class Consensus:
    """The place that has most support among the candidates."""

    members_K: Flags
    "Which candidates lie there."
    leader: int
    "The best-scored of them."
    lat: float | None
    "Of the place, degrees; None where no member's position is known."
    lon: float | None
    spread_m: float
    "Weighted root mean square distance of the members from it."
    elsewhere: float
    "The best score of a candidate that lies elsewhere; where there is none, the last candidate's."


def support_weights(scores_K: Doubles) -> Doubles:
    """How much each candidate counts, 0 to 1: the square of its score above the last one's, in
    shares of the best one's.

    The last of some ten candidates is what the gallery holds by chance. Squared, since many that
    are little above it, and stand together by chance, must not outweigh one that stands out. Equal
    scores count alike.
    """
    level, best = scores_K.min(), scores_K.max()
    return (
        np.ones_like(scores_K)
        if best <= level
        else np.asarray(((scores_K - level) / (best - level)) ** 2)
    )


def agreement(locations_K: Sequence[str], places_K2: Doubles, agreement_radius_m: float) -> Flags:
    """Which candidates lie at one place (K, K): those of one location, and those at most `agreement_radius_m`
    metres apart.
    """
    names_K = np.asarray(locations_K, dtype=np.str_)
    near_KK = (
        haversine_m(places_K2[:, None], places_K2[None]) <= agreement_radius_m
    )  # false of a NaN
    return np.asarray((names_K[:, None] == names_K[None]) | near_KK)


def find_consensus(
    scores_K: Doubles, locations_K: Sequence[str], places_K2: Doubles, agreement_radius_m: float
) -> Consensus:
    """The candidate with the highest sum of weights around it, and all that agree with it; K >= 1,
    best first.

    The position is their weighted geometric median: it stays at the best candidate until the others
    together pull harder than that one holds, so that one unlike neighbour moves nothing while a
    ring of overlapping images draws it to their middle.
    """
    weight_K = support_weights(scores_K)
    agree_KK = agreement(locations_K, places_K2, agreement_radius_m)
    members_K = agree_KK[int(np.argmax(agree_KK @ weight_K))]
    leader = int(np.argmax(members_K))
    others_K = scores_K[~members_K]
    known_K = members_K & ~np.isnan(places_K2).any(axis=1)
    lat = lon = None
    spread_m = 0.0
    if known_K.any():
        weight_N = np.maximum(
            weight_K[known_K], 1e-6
        )  # the last candidate's 0 would leave a place of its own without weight
        lat, lon = geometric_median(places_K2[known_K], weight_N)
        away_N = haversine_m(places_K2[known_K], np.array([lat, lon]))
        spread_m = float(np.sqrt(np.average(away_N**2, weights=weight_N)))
    return Consensus(
        members_K=members_K, leader=leader, lat=lat, lon=lon, spread_m=spread_m,
        elsewhere=float(others_K.max() if len(others_K) else scores_K.min()),
    )  # fmt: skip


def geometric_median(places_N2: Doubles, weight_N: Doubles) -> tuple[float, float]:
    """Latitude and longitude of the point with the least sum of weighted distances to these places;
    N >= 1.

    One of the places itself, exactly, where its weight is at least the pull of all others; else by
    Weiszfeld's iteration (Vardi and Zhang, The multivariate L1-median and associated data depth,
    2000, theorem 1).
    """
    points_N3 = on_sphere(places_N2)
    apart_NN3 = points_N3[None] - points_N3[:, None]
    distance_NN = np.linalg.norm(apart_NN3, axis=2)
    same_NN = distance_NN < 1e-3  # a millimetre: positions in degrees of seven digits are not finer
    pull_NN = np.where(same_NN, 0, weight_N / np.where(same_NN, 1, distance_NN))
    pull_N = np.linalg.norm((pull_NN[:, :, None] * apart_NN3).sum(axis=1), axis=1)
    holds_N = same_NN @ weight_N >= pull_N
    if holds_N.any():
        return float(places_N2[holds_N][0, 0]), float(places_N2[holds_N][0, 1])
    middle_3 = np.average(points_N3, axis=0, weights=weight_N)
    for _ in range(WEISZFELD_STEPS):
        share_N = weight_N / np.maximum(np.linalg.norm(points_N3 - middle_3, axis=1), 1e-6)
        middle_3 = np.average(points_N3, axis=0, weights=share_N)
    lat = np.degrees(np.arctan2(middle_3[2], np.hypot(middle_3[0], middle_3[1])))
    return float(lat), float(np.degrees(np.arctan2(middle_3[1], middle_3[0])))
