"""Answers for the single photos of a flight and their times -> answers given the whole flight.

In: answers with TRACK_CANDIDATES candidates each, times, a calibration, which turns scores into
probabilities, and what else is known of each photo: its refinement, its camera's direction, its
odometry. Out: as many answers, located where the track passes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.camera.pose import PartialPose
from pipeline.confidence.logistic import choice_log_probabilities
from pipeline.core.arrays import Doubles, Mask
from pipeline.core.geo import haversine_m
from pipeline.locate.calibration import Calibration
from pipeline.locate.flight_places import camera_places, gaze_ahead_m, refined_place, tile_places
from pipeline.locate.gallery_map import GalleryMap
from pipeline.locate.locate import Answer, Position, coordinates, level_scales, relative_scores
from pipeline.locate.movement import Places
from pipeline.locate.odometry import Travelled
from pipeline.locate.refined import with_refinement
from pipeline.locate.track import (
    Motion,
    SmoothedPhoto,
    TrackPhoto,
    TrackStart,
    filter_track,
    smooth_track,
)
from pipeline.matching.refine import Refinement

TRACK_THRESHOLD = 0.5
"""A photo of a flight is known where its location is likelier than all others and none together;
this needs no fitted threshold."""


@dataclass(frozen=True, kw_only=True)
class PhotoFacts:
    """What is known of a photo of a flight beside its candidates."""

    refinement: Refinement | None = None
    """How it lies on the map, by a refinement that the calibration's gate lets pass: a candidate
    beside the tiles."""
    pose: PartialPose = field(default_factory=PartialPose)
    "Of the camera: where it is, if a candidate is what it looks at."
    travelled: Travelled | None = None
    "By odometry."


def apply_track(
    answers: Sequence[Answer],
    times_s: Sequence[float],
    calibration: Calibration,
    motion: Motion,
    start: TrackStart | None = None,
    facts: Sequence[PhotoFacts] | None = None,
    online: bool = False,
) -> list[Answer]:
    """The answers given the whole flight, or for `online` given the photos up to each, in the order
    of `answers`, which are those of tiles. A photo that the track skips is unknown.

    Times are seconds since any moment, in any order; `start` is the rough position at the earliest.
    """
    facts = facts or [PhotoFacts()] * len(answers)
    order = sorted(range(len(answers)), key=lambda number: times_s[number])
    # The share of photos from outside the gallery was one in calibration and is another in flight.
    prior_shift = _log_odds(motion.elsewhere) - _log_odds(calibration.outside)
    none_log_odds = calibration.none_log_odds + prior_shift
    photos = [
        _track_photo(answers[at], facts[at], times_s[at], calibration, none_log_odds)
        for at in order
    ]
    decide = filter_track if online else smooth_track
    tracked = list(answers)
    for at, smoothed in zip(order, decide(photos, motion, start), strict=True):
        tracked[at] = _apply_smoothed(answers[at], facts[at].refinement, smoothed, calibration)
    return tracked


def motion_for_gallery(gallery: GalleryMap, max_speed: float, elsewhere: float = 0.1) -> Motion:
    """The motion model over a gallery; how far photos lie from their candidates is known of each
    candidate."""
    return Motion(
        max_speed=max_speed,
        gallery_positions=max(gallery.position_count, 1.0),
        spacing_m=gallery.spacing_m or math.inf,
        elsewhere=elsewhere,
    )


def _log_odds(share: float) -> float:
    return math.log(share / (1 - share))


def _track_photo(
    answer: Answer,
    facts: PhotoFacts,
    time_s: float,
    calibration: Calibration,
    none_log_odds: float,
) -> TrackPhoto:
    """The tiles, and behind them the refined place: it has the probability that it shows the right
    place, and the tiles share the rest with none of them."""
    hits = answer.candidates
    scores_1K = relative_scores(hits)[None]
    [log_p_C] = choice_log_probabilities(scores_1K, calibration.inverse_temperature, none_log_odds)
    ground = tile_places(coordinates(hits), _half_spacings(answer, calibration))
    camera = camera_places(ground, facts.pose)
    log_p_K = log_p_C[:-1]
    refinement, matching = facts.refinement, calibration.matching
    if refinement is not None and matching is not None:
        place = matching.place_probability(refinement)
        rest = math.log1p(-place)
        log_p_K, log_p_C = np.append(log_p_K + rest, math.log(place)), log_p_C + rest
        own_ground, own_camera = refined_place(refinement, matching.gate)
        ground = Places.joined([ground, own_ground])
        camera = Places.joined([camera, own_camera])
    return TrackPhoto(
        time_s=time_s,
        positions_K2=ground.positions_N2,
        log_p_K=log_p_K,
        log_p_none=float(log_p_C[-1]),
        ground=ground,
        camera=camera,
        ahead_m=gaze_ahead_m(facts.pose),
        travelled=facts.travelled,
    )


def _half_spacings(answer: Answer, calibration: Calibration) -> Doubles:
    """Half a spacing of each candidate's level (K,), metres; 0 where the spacing is not known."""
    scale_K = level_scales(answer.candidates, calibration.finest_side_m)
    return scale_K * (calibration.spacing_m or 0.0) / 2


def _apply_smoothed(
    answer: Answer,
    refinement: Refinement | None,
    smoothed: SmoothedPhoto,
    calibration: Calibration,
) -> Answer:
    """The answer at the chosen candidate; its probability is that of all candidates of this
    place. One at a tile that agrees with the refinement is refined too."""
    hits, chosen = answer.candidates, smoothed.chosen
    tiles_p_K = smoothed.p_K[: len(hits)]
    if refinement is not None and chosen is not None:
        near_K = _agree(answer, refinement, calibration)
        if chosen == len(hits) or near_K[chosen]:
            place = float(smoothed.p_K[len(hits) :].sum() + tiles_p_K[near_K].sum())
            return _at_refinement(answer, refinement, near_K, place, calibration)
    location = answer.location if chosen is None else hits[chosen].location
    at_location_K = np.array([hit.location == location for hit in hits], np.bool_)
    probability = float(tiles_p_K[at_location_K].sum())
    if chosen is None:
        return replace(answer, probability=probability, within_m=None, known=False)
    lat, lon = hits[chosen].lat, hits[chosen].lon
    position = None
    if lat is not None and lon is not None:
        radius_m = float(_half_spacings(answer, calibration)[chosen])
        position = Position(lat=lat, lon=lon, radius_m=radius_m, how="track")
    return replace(
        answer,
        position=position,
        location=location,
        probability=probability,
        within_m=None,
        agreeing=int(at_location_K.sum()),
        known=probability >= TRACK_THRESHOLD,
    )


def _agree(answer: Answer, refinement: Refinement, calibration: Calibration) -> Mask:
    """Which candidates (K,) lie within a spacing of their level from the refined place."""
    here = np.array([refinement.lat, refinement.lon])
    away_K = haversine_m(coordinates(answer.candidates), here)
    return np.asarray(away_K <= 2 * _half_spacings(answer, calibration))  # NaN: False


def _at_refinement(
    answer: Answer,
    refinement: Refinement,
    near_K: Mask,
    place: float,
    calibration: Calibration,
) -> Answer:
    """The answer at the refined place. `place`: probability of this place given the flight; the
    answer's is that of a position within the gate's distance."""
    refined = with_refinement(answer, refinement, calibration, of_flight=True)
    matching = calibration.matching
    share = matching.share_within(refinement) if matching else 1.0
    hits = [hit for hit, near in zip(answer.candidates, near_K, strict=True) if near]
    return replace(
        refined,
        location=hits[0].location if hits else answer.location,
        probability=min(place, 1.0) * share,
        agreeing=len(hits),
        known=place >= TRACK_THRESHOLD,
    )
