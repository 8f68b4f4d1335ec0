"""Answers of single photos, and when they were taken -> answers in the light of the whole flight.

In: answers with TRACKED candidates each, times, and a calibration, which says how much a score is
worth. Out: the same number of answers, whose places are those that the track passes through.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.locate.calibration import Calibration
from pipeline.locate.gallery_map import GalleryMap
from pipeline.locate.locate import Answer, Position, coordinates, relative_scores
from pipeline.locate.logistic import choice_log_probabilities
from pipeline.locate.track import Motion, SmoothedPhoto, TrackPhoto, TrackStart, smooth_track

TRACK_THRESHOLD = 0.5
"""A flight's photo is known where its place is likelier than all others and elsewhere together;
this needs no threshold."""


def apply_track(
    answers: Sequence[Answer],
    times_s: Sequence[float],
    confidence: Calibration,
    motion: Motion,
    start: TrackStart | None = None,
) -> list[Answer]:
    """What the flight says of each photo, in the order given. A photo that the track passes over is
    not known.

    Times are seconds since any moment and may be in any order; a rough start is where the earliest
    photo was taken.
    """
    order = sorted(range(len(answers)), key=lambda number: times_s[number])
    # The calibration's share of photos from outside the gallery is another than the flight's.
    outside = confidence.elsewhere - _log_odds(confidence.outside) + _log_odds(motion.elsewhere)
    flight = [
        _track_photo(answers[number], times_s[number], confidence.inverse_temperature, outside)
        for number in order
    ]
    settled = list(answers)
    for number, found in zip(order, smooth_track(flight, motion, start), strict=True):
        settled[number] = _apply_smoothed(answers[number], found, confidence)
    return settled


def motion_for_gallery(gallery: GalleryMap, max_speed: float, elsewhere: float = 0.1) -> Motion:
    """The motion of a UAV over a gallery: at either end of a way a photo may lie half a spacing
    from its gallery image.
    """
    spacing_m = gallery.spacing_m
    return Motion(
        max_speed=max_speed,
        slack_m=spacing_m or 0.0,
        places=max(gallery.distinct, 1.0),
        spacing_m=spacing_m or math.inf,
        elsewhere=elsewhere,
    )


def _log_odds(share: float) -> float:
    return math.log(share / (1 - share))


def _track_photo(
    answer: Answer, time_s: float, inverse_temperature: float, outside: float
) -> TrackPhoto:
    hits = answer.candidates
    log_chance_C = choice_log_probabilities(
        relative_scores(hits)[None], inverse_temperature, outside
    )[0]
    return TrackPhoto(
        time_s=time_s,
        places_K2=coordinates(hits),
        log_chance_K=log_chance_C[:-1],
        log_elsewhere=float(log_chance_C[-1]),
    )


def _apply_smoothed(answer: Answer, found: SmoothedPhoto, confidence: Calibration) -> Answer:
    """The answer's place is that of the candidate chosen; its probability that of all candidates of
    this location.
    """
    hits, chosen = answer.candidates, found.chosen
    location = answer.location if chosen is None else hits[chosen].location
    at_K = np.array([hit.location == location for hit in hits], np.bool_)
    probability = float(found.chance_K[at_K].sum())
    if chosen is None:
        return replace(answer, probability=probability, known=False)
    lat, lon = hits[chosen].lat, hits[chosen].lon
    position = None
    if lat is not None and lon is not None:
        position = Position(lat=lat, lon=lon, radius_m=(confidence.spacing_m or 0.0) / 2)
    return replace(
        answer,
        position=position,
        location=location,
        probability=probability,
        agreeing=int(at_K.sum()),
        known=probability >= TRACK_THRESHOLD,
    )
