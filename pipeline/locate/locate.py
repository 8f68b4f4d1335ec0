"""Embeddings of photos -> answers: a position, a probability, and the candidates behind them.

In: an opened index and unit vectors. Out: one Answer per vector. The position is the one that the
best candidates agree on; the probability comes from a calibration and is None without one.
Shapes: Q photos, D dimensions, K candidates.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pipeline.camera.framing import Framing, Level
from pipeline.camera.uncertainty import Ellipse
from pipeline.core.arrays import Doubles, Floats
from pipeline.core.filters import Filter
from pipeline.index.searcher import Hit, Searchable
from pipeline.locate.calibration import Calibration
from pipeline.locate.consensus import Consensus, find_consensus
from pipeline.matching.refine import Refinement

CONSENSUS_CANDIDATES = 10
"""Candidates that decide on position and probability, however many are listed: a calibration holds
for one number only. Ten, since a location that agrees with none of the ten best has little support,
and the tenth score is well within what a gallery reaches by chance."""

LEVEL_BONUS = 0.02
"""Added to the scores of images that show as much ground as the photo's view does. A trial on 100
photos: as good as searching these alone or better, for other levels may show the place too, and a
height that is wrong by half leads to another level (docs/decisions.md)."""

UNCALIBRATED_SPACINGS = 0.5
"""Agreement radius in spacings of the gallery, where no calibration has chosen one. Half a spacing
joins only images of one location: whether neighbours overlap is not known, and neighbours that show
other ground would pull the position away."""


How = Literal["tile", "refined", "track"]
"""How a position came about: the middle of gallery images, the photo matched with the map's pixels,
or the gallery image where the whole flight passes."""


@dataclass(frozen=True, kw_only=True)
class Position:
    """The estimated position of a photo."""

    lat: float
    "Degrees north, WGS84."
    lon: float
    "Degrees east."
    radius_m: float
    """Uncertainty in metres, if the location is right: half the distance to the next gallery image
    and the spread of the agreeing candidates, added in quadrature; of a refined position, half the
    longer axis of its ellipse."""
    how: How = "tile"
    "How it came about."
    ellipse: Ellipse | None = None
    "95 % of a refined position's error, if it is right."


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The answer for one photo."""

    position: Position | None
    "Null where no candidate of the location has a position."
    location: str | None
    "Name of the location: that of its best candidate; null where the search found nothing."
    probability: float | None
    "Probability that the location is right, 0 to 1; null without a calibration."
    within_m: float | None = None
    """The position counts as right within so many metres of the ground that the photo's middle
    shows; null without a probability, and for a flight's photos at tiles, whose probability is that
    of the location."""
    known: bool
    "False (unknown) where the probability is below the threshold, or nothing was found."
    candidates: tuple[Hit, ...]
    "Best first."
    agreeing: int
    "How many of the candidates considered lie at the location."
    refinement: Refinement | None = None
    "How the photo lies on the map; null where it was not matched, or the match does not hold."
    framing: Framing = "none"
    "How the photo was framed for the search, by what is known of its camera."


NO_ANSWER = Answer(
    position=None, location=None, probability=None, known=False, candidates=(), agreeing=0
)
"The answer where the search found nothing."


def locate_embeddings(
    index: Searchable,
    embeddings_QD: Floats,
    k: int = CONSENSUS_CANDIDATES,
    where: Filter | None = None,
    calibration: Calibration | None = None,
    spacing_m: float | None = None,
    finest_side_m: float | None = None,
) -> list[Answer]:
    """One answer per embedding (Q, D), each with its `k` best candidates.

    `where` restricts the search; `calibration` must belong to this index. Without a calibration the
    agreement radius follows from `spacing_m`, the gallery's spacing; without either, candidates
    agree where they have one location. Raises InputError where the embeddings do not fit the index.
    """
    hits = index.search(embeddings_QD, max(k, CONSENSUS_CANDIDATES), where)
    return answers_from_hits(hits, k, calibration, spacing_m, finest_side_m)


def merge_views(hits_of_views: Sequence[Sequence[Hit]]) -> list[Hit]:
    """The candidates of several views of one photo: each gallery image by its best score, best
    first, as many as one view has."""
    best: dict[str, Hit] = {}
    for hits in hits_of_views:
        for hit in hits:
            if hit.key not in best or hit.score > best[hit.key].score:
                best[hit.key] = hit
    merged = sorted(best.values(), key=lambda hit: -hit.score)
    return merged[: max(map(len, hits_of_views), default=0)]


def search_views(
    index: Searchable,
    views_of_photos: Sequence[Floats],
    k: int,
    where: Filter | None = None,
    levels: Sequence[Level | None] | None = None,
) -> list[list[Hit]]:
    """The `k` best candidates of each photo by its views (V, D), all in one search.

    `levels`: per photo the level that it was framed for, whose images are preferred by LEVEL_BONUS;
    None: it was framed for none. Raises InputError where the embeddings do not fit the index.
    """
    if not views_of_photos:
        return []
    found = index.search(np.concatenate(views_of_photos), k, where)
    ends = np.cumsum([len(views) for views in views_of_photos]).tolist()
    hits = [merge_views(found[start:end]) for start, end in zip([0, *ends[:-1]], ends, strict=True)]
    return [
        _prefer_level(own, level)
        for own, level in zip(hits, levels or [None] * len(hits), strict=True)
    ]


def _prefer_level(hits: list[Hit], level: Level | None) -> list[Hit]:
    """The hits with LEVEL_BONUS for those of a level, best first."""
    if level is None:
        return hits
    raised = [
        replace(hit, score=hit.score + LEVEL_BONUS)
        if hit.side_m is not None and level[0] <= hit.side_m <= level[1]
        else hit
        for hit in hits
    ]
    return sorted(raised, key=lambda hit: -hit.score)


def answers_from_hits(
    hits_of_photos: Sequence[Sequence[Hit]],
    k: int,
    calibration: Calibration | None = None,
    spacing_m: float | None = None,
    finest_side_m: float | None = None,
) -> list[Answer]:
    """One answer per photo from its candidates, best first; `k` of them are listed in it.

    `spacing_m`, `finest_side_m`: the gallery's, where there is no calibration.
    """
    radius_m = UNCALIBRATED_SPACINGS * (spacing_m or 0.0)
    if calibration:
        spacing_m, finest_side_m = calibration.spacing_m, calibration.finest_side_m
        radius_m = calibration.agreement_radius_m
    return [
        _answer(hits, consensus_of(hits, radius_m, finest_side_m), k, calibration, spacing_m or 0.0)
        if hits
        else NO_ANSWER
        for hits in hits_of_photos
    ]


def _answer(
    hits: Sequence[Hit],
    consensus: Consensus,
    k: int,
    calibration: Calibration | None,
    spacing: float,
) -> Answer:
    probability, threshold, position = None, 0.0, None
    within_m = calibration.tolerance_m if calibration else None
    if calibration:
        probability = calibration.probability(consensus, consensus_scores(hits))
        threshold = calibration.threshold
    if consensus.lat is not None and consensus.lon is not None:
        radius_m = math.hypot(consensus.spread_m, consensus.scale * spacing / 2)
        position = Position(lat=consensus.lat, lon=consensus.lon, radius_m=radius_m)
    return Answer(
        position=position,
        location=hits[consensus.leader].location,
        probability=probability,
        within_m=within_m,
        known=probability is None or probability >= threshold,
        candidates=tuple(hits[:k]),
        agreeing=int(consensus.members_K.sum()),
    )


def consensus_of(
    hits: Sequence[Hit], agreement_radius_m: float, finest_side_m: float | None = None
) -> Consensus:
    """The consensus of the best CONSENSUS_CANDIDATES hits. `finest_side_m`: side of the gallery's
    finest level, to which the radius belongs; None where its levels are not known."""
    hits = hits[:CONSENSUS_CANDIDATES]
    locations = [hit.location for hit in hits]
    scale_K = level_scales(hits, finest_side_m)
    scores_K = consensus_scores(hits)
    return find_consensus(scores_K, locations, coordinates(hits), agreement_radius_m, scale_K)


def level_scales(hits: Sequence[Hit], finest_side_m: float | None) -> Doubles:
    """How many times the side of the finest level the ground of each hit has (K,); 1 where unknown,
    and for the finest."""
    sides = [(hit.side_m or finest_side_m) if finest_side_m else None for hit in hits]
    scales = [side / finest_side_m if side and finest_side_m else 1.0 for side in sides]
    return np.maximum(np.array(scales, np.float64), 1.0)


def consensus_scores(hits: Sequence[Hit]) -> Doubles:
    """Scores (K,) of the candidates that the consensus considers, best first."""
    return np.array([hit.score for hit in hits[:CONSENSUS_CANDIDATES]])


def relative_scores(hits: Sequence[Hit]) -> Doubles:
    """Scores of any number of hits, relative to the last one that the consensus considers.

    The level that a gallery reaches by chance differs from photo to photo; this removes it.
    """
    scores_K = np.array([hit.score for hit in hits])
    return np.asarray(scores_K - scores_K[:CONSENSUS_CANDIDATES][-1:].sum())


def coordinates(hits: Sequence[Hit]) -> Doubles:
    """Latitudes and longitudes (K, 2) of hits, NaN where unknown."""
    pairs = [(hit.lat, hit.lon) for hit in hits]
    return np.array(pairs, dtype=np.float64).reshape(-1, 2)  # None becomes NaN
