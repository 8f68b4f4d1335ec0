"""Answers of retrieval, and the map's pixels -> answers within metres.

In: an answer with its candidates, and a photo's features with what is known of its camera. Out: the
answer at the place that matching finds, where that holds; else as it was.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace

from pipeline.core.geo import Circle
from pipeline.locate.calibration import Calibration, confidence_features
from pipeline.locate.locate import Answer, Position, consensus_of, consensus_scores
from pipeline.matching.gate import LEAST_PROBABILITY, beyond_chance, holds
from pipeline.matching.map_windows import MapWindows
from pipeline.matching.photo_features import MatchablePhoto
from pipeline.matching.refine import Refinement, refine, refine_densely

MOST_WINDOWS = 3
"Windows that a photo is matched with: around the answer, then around other candidates."
VOTED_WINDOWS = 2
"Where none of them holds: around places that features of the whole map vote for."
DENSE_WINDOWS = 2
"Where SIFT holds in none of these: around the answer and its candidates, by dense features."


def refine_answer(
    answer: Answer,
    photo: MatchablePhoto,
    windows: MapWindows,
    away_from: Circle | None = None,
) -> Refinement | None:
    """The photo matched with the map around an answer and around its other candidates; where that
    does not hold by the rule for all maps, around the places that the features of the whole map
    vote for, if these are searched (not within `away_from`); where that does not either, by dense
    features around the answer and its candidates, if the map has them. None where no view holds
    that a camera can have."""
    near = windows.around(_positions(answer), MOST_WINDOWS, photo.reach_m)
    found = refine(photo, near)
    if windows.search is not None and answer.candidates and not (found and holds(found)):
        key = answer.candidates[0].key
        voted = windows.search.places(photo, VOTED_WINDOWS, away_from)
        places = [(lat, lon, key) for lat, lon in voted]
        other = refine(photo, windows.around(places, VOTED_WINDOWS, photo.reach_m))
        both = [one for one in (found, other) if one is not None]
        found = max(both, key=lambda one: one.inliers, default=None)
    return _or_densely(found, photo, windows, _positions(answer), DENSE_WINDOWS)


def _or_densely(
    found: Refinement | None,
    photo: MatchablePhoto,
    windows: MapWindows,
    positions: Iterable[tuple[float, float, str]],
    most: int,
) -> Refinement | None:
    """What SIFT found, if it holds by the rule for all maps; else what dense features find, if that
    is more than chance."""
    if windows.dense is None or photo.promised_33 is None or (found and holds(found)):
        return found
    near = windows.around(positions, most, photo.reach_m, "dense")
    dense = refine_densely(photo, near, windows.dense)
    return dense if dense and beyond_chance(dense) else found


def refine_at(answer: Answer, photo: MatchablePhoto, windows: MapWindows) -> Refinement | None:
    """The photo matched with the map around an answer's position alone, in a window as large as for
    the tile of its location; None where no view holds, or the answer has no position."""
    if answer.position is None:
        return None
    at = answer.position.lat, answer.position.lon
    keys = [hit.key for hit in answer.candidates if (hit.lat, hit.lon) == at]
    key = next(iter(keys), answer.candidates[0].key)
    place = [(*at, key)]
    found = refine(photo, windows.around(place, 1, photo.reach_m))
    return _or_densely(found, photo, windows, place, 1)


def _positions(answer: Answer) -> Iterator[tuple[float, float, str]]:
    """The answer's position, then its candidates', each with the key of the tile that tells the
    window's size."""
    if answer.position is not None:
        yield answer.position.lat, answer.position.lon, answer.candidates[0].key
    for hit in answer.candidates:
        if hit.lat is not None and hit.lon is not None:
            yield hit.lat, hit.lon, hit.key


def with_refinement(
    answer: Answer,
    refinement: Refinement | None,
    calibration: Calibration | None = None,
    of_flight: bool = False,
) -> Answer:
    """The answer at the refined place, if the refinement holds.

    Its probability is that of the calibration's gate, and null where the calibration knows nothing
    of matching; below LEAST_PROBABILITY the answer is unknown. Where the refinement does not hold,
    that speaks against the tile too: its probability becomes that of such photos. Neither is so if
    the answer is `of_flight`, which knows more than this photo.
    """
    matching = calibration.matching if calibration else None
    gate = matching.gate if matching else None
    if refinement is not None and holds(refinement, gate):
        ellipse = gate.ellipse(refinement) if gate else refinement.ellipse
        position = Position(
            lat=refinement.lat,
            lon=refinement.lon,
            radius_m=ellipse.major_m,
            how="refined",
            ellipse=ellipse,
        )
        p = gate.probability(refinement) if gate else None
        return replace(
            answer,
            position=position,
            probability=p,
            within_m=gate.within_m if gate else None,
            known=of_flight or p is None or p >= LEAST_PROBABILITY,
            refinement=refinement,
        )
    if calibration is None or matching is None or not answer.candidates or of_flight:
        return answer
    consensus = consensus_of(
        answer.candidates, calibration.agreement_radius_m, calibration.finest_side_m
    )
    x_1F = confidence_features(consensus, consensus_scores(answer.candidates))[None]
    probability = float(matching.tile_model.probabilities(x_1F)[0])
    return replace(answer, probability=probability, known=probability >= matching.tile_threshold)
