"""Embeddings of photos -> answers: a position, how sure it is, and the candidates behind it.

In: an opened index and unit vectors. Out: one Answer per vector. The position is that of the place which the best candidates
agree on; the probability comes from a calibration, without which there is none.
Shapes: Q photos, D dimensions, K candidates.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.consensus import Consensus, consensus
from pipeline.features import Floats
from pipeline.index import Hit
from pipeline.metrics import Doubles

CONSIDERED = 10
"""Candidates that decide on place and probability, whatever number is shown: a calibration holds for one number only. Ten,
since a place that agrees with none of the ten best has little to say, and the tenth is well within what comes by chance."""


@dataclass(frozen=True, kw_only=True)
class Position:
    """Where a photo was taken, as far as it can be told."""

    lat: float
    "Degrees north, WGS84."
    lon: float
    "Degrees east."
    radius_m: float
    "Of uncertainty, if the place is right: half way to the next gallery image, and how far the agreeing ones lie apart."


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What is said of one photo."""

    position: Position | None
    "None where no candidate of the place has a position."
    location: str | None
    "The place's name: the location of its best candidate; None where the search found nothing."
    probability: float | None
    "That the place is right, 0 to 1; None without a calibration."
    known: bool
    "False: unknown, as the probability is below the calibration's threshold, or nothing was found."
    candidates: tuple[Hit, ...]
    "Best first."
    agreeing: int
    "How many of the candidates considered lie at the place."


def locate(
    index: Any, embeddings_QD: Floats, k: int = CONSIDERED, where: Any = None, confidence: Any = None
) -> list[Answer]:
    """One answer per embedding (Q, D), each with its `k` best candidates.

    `where` narrows the search; `confidence` is the calibration of this index. Raises InputError for a `where` that is none.
    """
    most = max(k, CONSIDERED)
    found = index.search(embeddings_QD, most) if where is None else index.search(embeddings_QD, most, where)
    return [answer(hits, k, confidence) for hits in found]


def answer(hits: Sequence[Hit], k: int = CONSIDERED, confidence: Any = None) -> Answer:
    """What the candidates of one photo, best first, amount to; `k` of them go into the answer."""
    if not hits:
        return Answer(position=None, location=None, probability=None, known=False, candidates=(), agreeing=0)
    agreed = judged(hits, confidence.within_m if confidence else 0.0)
    probability = confidence.probability(agreed, hits) if confidence else None
    position = None
    if agreed.lat is not None and agreed.lon is not None:
        position = Position(lat=agreed.lat, lon=agreed.lon, radius_m=agreed.spread_m)
    return Answer(
        position=position, location=hits[agreed.leader].location, probability=probability,
        known=probability is None or probability >= confidence.threshold,
        candidates=tuple(hits[:k]), agreeing=int(agreed.members_K.sum()),
    )  # fmt: skip


def judged(hits: Sequence[Hit], within_m: float) -> Consensus:
    """The place that the best CONSIDERED candidates agree on."""
    hits = hits[:CONSIDERED]
    return consensus(np.array([hit.score for hit in hits]), [hit.location for hit in hits], places(hits), within_m)


def places(hits: Sequence[Hit]) -> Doubles:
    """Latitudes and longitudes (K, 2) of candidates, NaN where unknown."""
    return np.array([(hit.lat, hit.lon) for hit in hits], dtype=np.float64).reshape(-1, 2)  # None becomes NaN
