"""Answers for the single photos of a flight and their times -> answers given the whole flight.

In: answers with TRACK_CANDIDATES candidates each, times, and a calibration, which turns scores into
probabilities. Out: as many answers, located where the track passes.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.confidence.logistic import choice_log_probabilities
from pipeline.locate.calibration import Calibration
from pipeline.locate.gallery_map import GalleryMap
from pipeline.locate.locate import Answer, Position, coordinates, level_scales, relative_scores
from pipeline.locate.track import Motion, SmoothedPhoto, TrackPhoto, TrackStart, smooth_track

TRACK_THRESHOLD = 0.5
"""A photo of a flight is known where its location is likelier than all others and none together;
this needs no fitted threshold."""


def apply_track(
    answers: Sequence[Answer],
    times_s: Sequence[float],
    calibration: Calibration,
    motion: Motion,
    start: TrackStart | None = None,
) -> list[Answer]:
    """The answers given the whole flight, in the order of `answers`. A photo that the track skips
    is unknown.

    Times are seconds since any moment, in any order; `start` is the rough position at the earliest.
    """
    order = sorted(range(len(answers)), key=lambda number: times_s[number])
    # The share of photos from outside the gallery was one in calibration and is another in flight.
    prior_shift = _log_odds(motion.elsewhere) - _log_odds(calibration.outside)
    none_log_odds = calibration.none_log_odds + prior_shift
    temperature = calibration.inverse_temperature
    photos = [_track_photo(answers[at], times_s[at], temperature, none_log_odds) for at in order]
    tracked = list(answers)
    for at, smoothed in zip(order, smooth_track(photos, motion, start), strict=True):
        tracked[at] = _apply_smoothed(answers[at], smoothed, calibration)
    return tracked


def motion_for_gallery(gallery: GalleryMap, max_speed: float, elsewhere: float = 0.1) -> Motion:
    """The motion model over a gallery: at either end of a distance a photo may lie half a spacing
    from its gallery image."""
    return Motion(
        max_speed=max_speed,
        slack_m=gallery.spacing_m or 0.0,
        gallery_positions=max(gallery.position_count, 1.0),
        spacing_m=gallery.spacing_m or math.inf,
        elsewhere=elsewhere,
    )


def _log_odds(share: float) -> float:
    return math.log(share / (1 - share))


def _track_photo(
    answer: Answer, time_s: float, inverse_temperature: float, none_log_odds: float
) -> TrackPhoto:
    hits = answer.candidates
    scores_1K = relative_scores(hits)[None]
    log_p_C = choice_log_probabilities(scores_1K, inverse_temperature, none_log_odds)[0]
    return TrackPhoto(
        time_s=time_s,
        positions_K2=coordinates(hits),
        log_p_K=log_p_C[:-1],
        log_p_none=float(log_p_C[-1]),
    )


def _apply_smoothed(answer: Answer, smoothed: SmoothedPhoto, calibration: Calibration) -> Answer:
    """The answer at the chosen candidate; its probability is that of all candidates of this
    location."""
    hits, chosen = answer.candidates, smoothed.chosen
    location = answer.location if chosen is None else hits[chosen].location
    at_location_K = np.array([hit.location == location for hit in hits], np.bool_)
    probability = float(smoothed.p_K[at_location_K].sum())
    if chosen is None:
        return replace(answer, probability=probability, within_m=None, known=False)
    lat, lon = hits[chosen].lat, hits[chosen].lon
    position = None
    if lat is not None and lon is not None:
        [scale] = level_scales(hits[chosen : chosen + 1], calibration.finest_side_m).tolist()
        radius_m = scale * (calibration.spacing_m or 0.0) / 2
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
