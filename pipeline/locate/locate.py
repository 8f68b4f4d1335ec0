"""Embeddings of photos -> answers: a position, how sure it is, and the candidates behind it.

In: an opened index and unit vectors. Out: one Answer per vector. The position is that of the place
which the best candidates agree on; the probability comes from a calibration, without which there is
none. Shapes: Q photos, D dimensions, K candidates.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Doubles
from pipeline.features.table import Floats
from pipeline.index.filters import Filter
from pipeline.index.searcher import Hit, Searchable
from pipeline.locate.calibration import Calibration
from pipeline.locate.consensus import Consensus, find_consensus

CONSENSUS_CANDIDATES = 10
"""Candidates that decide on place and probability, whatever number is shown: a calibration holds
for one number only. Ten, since a place that agrees with none of the ten best has little to say, and
the tenth is well within what comes by chance."""


UNCALIBRATED_SPACINGS = 0.5
"""Of the gallery's spacing: how far apart candidates may lie that agree, where no calibration has
chosen. Only images of one place: whether neighbours overlap is not known, and unlike ones would
lead away."""


@dataclass(frozen=True, kw_only=True)
class Position:
    """Where a photo was taken, as far as it can be told."""

    lat: float
    "Degrees north, WGS84."
    lon: float
    "Degrees east."
    radius_m: float
    """Of uncertainty, if the place is right: half way to the next gallery image, and how far the
    agreeing ones lie apart."""


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


NO_ANSWER = Answer(
    position=None, location=None, probability=None, known=False, candidates=(), agreeing=0
)
"What is said where the search found nothing."


def locate_embeddings(
    index: Searchable,
    embeddings_QD: Floats,
    k: int = CONSENSUS_CANDIDATES,
    where: Filter | None = None,
    confidence: Calibration | None = None,
    spacing_m: float | None = None,
) -> list[Answer]:
    """One answer per embedding (Q, D), each with its `k` best candidates.

    `where` narrows the search; `confidence` is the calibration of this index. Without one `spacing_m`, the gallery's, says how
    far apart candidates may lie that agree; without either they agree where they are of one location.
    Raises InputError where the embeddings are not the index's.
    """
    most = max(k, CONSENSUS_CANDIDATES)
    return answers_from_hits(index.search(embeddings_QD, most, where), k, confidence, spacing_m)


def answers_from_hits(
    found: Sequence[Sequence[Hit]],
    k: int,
    confidence: Calibration | None = None,
    spacing_m: float | None = None,
) -> list[Answer]:
    """What the candidates of each photo, best first, amount to; `k` of them go into the answer."""
    spacing = (confidence.spacing_m if confidence else spacing_m) or 0.0
    agreement_radius_m = (
        confidence.agreement_radius_m if confidence else UNCALIBRATED_SPACINGS * spacing
    )
    return [
        _answer(hits, consensus_of(hits, agreement_radius_m), k, confidence, spacing)
        if hits
        else NO_ANSWER
        for hits in found
    ]


def _answer(
    hits: Sequence[Hit], agreed: Consensus, k: int, confidence: Calibration | None, spacing: float
) -> Answer:  # fmt: skip
    probability = confidence.probability(agreed, consensus_scores(hits)) if confidence else None
    position = None
    if agreed.lat is not None and agreed.lon is not None:
        radius_m = math.hypot(agreed.spread_m, spacing / 2)
        position = Position(lat=agreed.lat, lon=agreed.lon, radius_m=radius_m)
    return Answer(
        position=position, location=hits[agreed.leader].location, probability=probability,
        known=confidence is None or probability is None or probability >= confidence.threshold,
        candidates=tuple(hits[:k]), agreeing=int(agreed.members_K.sum()),
    )  # fmt: skip


def consensus_of(hits: Sequence[Hit], agreement_radius_m: float) -> Consensus:
    """The place that the best CONSIDERED candidates agree on."""
    hits = hits[:CONSENSUS_CANDIDATES]
    return find_consensus(
        consensus_scores(hits),
        [hit.location for hit in hits],
        coordinates(hits),
        agreement_radius_m,
    )


def consensus_scores(hits: Sequence[Hit]) -> Doubles:
    """Scores (K,) of the candidates considered, best first."""
    return np.array([hit.score for hit in hits[:CONSENSUS_CANDIDATES]])


def relative_scores(hits: Sequence[Hit]) -> Doubles:
    """Scores of any number of candidates above that of the last one considered: what a gallery
    holds by chance differs from photo to photo."""
    scores_K = np.array([hit.score for hit in hits])
    return np.asarray(scores_K - scores_K[:CONSENSUS_CANDIDATES][-1:].sum())


def coordinates(hits: Sequence[Hit]) -> Doubles:
    """Latitudes and longitudes (K, 2) of candidates, NaN where unknown."""
    return np.array([(hit.lat, hit.lon) for hit in hits], dtype=np.float64).reshape(
        -1, 2
    )  # None becomes NaN
