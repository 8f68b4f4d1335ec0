"""Places of a map that resemble each other: there, an answer without matching may be the other one.

In: an opened index over the map. Out: pairs of its images that are far apart and alike.
Shapes: N rows, D dimensions.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Doubles, Floats
from pipeline.core.geo import haversine_m
from pipeline.index.searcher import Hit, Searchable

CANDIDATES = 40
"Of each image; those beside it are left out."


@dataclass(frozen=True, kw_only=True)
class Lookalike:
    """Two images of the gallery."""

    keys: tuple[str, str]
    score: float
    "Cosine similarity."
    apart_m: float


def find_lookalikes(
    index: Searchable,
    keys: Sequence[str],
    positions_N2: Doubles,
    embeddings_ND: Floats,
    apart_m: float,
    count: int,
) -> list[Lookalike]:
    """The most alike pairs of images at least `apart_m` apart, each image in one of them, at most
    `count`."""
    found: list[Lookalike] = []
    hits_of = index.search(embeddings_ND, CANDIDATES) if len(keys) else []
    for key, position_2, hits in zip(keys, positions_N2, hits_of, strict=True):
        far = [(hit, away_m) for hit in hits if (away_m := _away(hit, position_2)) >= apart_m]
        if far:
            hit, away_m = far[0]
            found.append(Lookalike(keys=(key, hit.key), score=hit.score, apart_m=away_m))
    found.sort(key=lambda one: -one.score)
    kept: list[Lookalike] = []
    used: set[str] = set()
    for one in found:
        if len(kept) < count and not used & set(one.keys):
            kept.append(one)
            used |= set(one.keys)
    return kept


def _away(hit: Hit, position_2: Doubles) -> float:
    """Metres from a position to a hit; -1 where the hit has none."""
    if hit.lat is None or hit.lon is None:
        return -1.0
    return float(haversine_m(np.array([hit.lat, hit.lon]), position_2))
