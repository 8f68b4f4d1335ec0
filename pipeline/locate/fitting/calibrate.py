"""Fits a calibration on photos of known locations that the encoder was not trained on.

In: for each photo the candidates that a gallery with its location returns, and those of a gallery
without it, so that the model sees right answers, wrong ones, and photos that match nothing. Out: a
Calibration. Never fitted on the test set, whose figures it would then describe. NumPy only, no I/O.
Shapes: N examples, F features, K candidates, A agreement factors, L locations.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.confidence.cross_validation import cross_validated_probabilities, youden_threshold
from pipeline.confidence.logistic import fit_choice_model, fit_logistic
from pipeline.confidence.reliability import expected_calibration_error, reliability_bins
from pipeline.core.arrays import Doubles
from pipeline.core.errors import InputError
from pipeline.core.geo import haversine_m
from pipeline.index.searcher import Hit
from pipeline.locate.calibration import Calibration, confidence_features
from pipeline.locate.consensus import Consensus
from pipeline.locate.locate import consensus_of, consensus_scores, relative_scores
from pipeline.locate.settings import CalibrationCriteria
from pipeline.locate.track import TRACK_CANDIDATES

AGREEMENT_FACTORS = (0.5, 1.5, 2.5)
"""Agreement radii that are tried, in spacings of the gallery. 0.5: only images of one location;
1.5: the neighbours on a grid, diagonal ones too; 2.5: two steps away. Which is best depends on
whether neighbouring images overlap."""

MIN_LOCATIONS = 10
"Fewer locations say little about unseen ones."


@dataclass(frozen=True, kw_only=True)
class CalibrationExample:
    """A photo of a known location, and the candidates that a gallery returns for it."""

    location: str
    lat: float | None
    "Of the ground that the photo shows; None where unknown."
    lon: float | None
    inside: tuple[Hit, ...]
    "Candidates, best first, from a gallery that contains the location."
    outside: tuple[Hit, ...]
    """Candidates from a gallery that does not contain it; empty where no image lies far enough
    away."""


@dataclass(frozen=True, kw_only=True)
class CalibrationContext:
    """The encoder, gallery and photos of a calibration, recorded in its file."""

    fingerprint: str
    "Fingerprint of the encoder."
    gallery_rows: int
    spacing_m: float | None
    "Median distance of a gallery position to the next one; None where no two are known."
    finest_side_m: float | None = None
    "Side of the gallery's finest level; None where its levels are not known."
    photo_selection: str = ""
    "Which photos were searched, in words."


def fit_calibration(
    examples: Sequence[CalibrationExample],
    criteria: CalibrationCriteria,
    context: CalibrationContext,
) -> Calibration:
    """Fit the confidence model, its threshold and the track's choice model.

    Raises InputError where the examples show too few locations, where no answer is right, or where
    no example has candidates from outside.
    """
    locations_N = np.array([one.location for one in examples], dtype=np.str_)
    location_count = len(np.unique(locations_N))
    if location_count < MIN_LOCATIONS:
        raise InputError(
            f"{len(examples)} photos of {location_count} locations to calibrate on, expected at "
            f"least {MIN_LOCATIONS} locations that the encoder was not trained on; take more "
            "photos, of a larger map; or name another --split, or train with --hold-out 0.1"
        )
    radius_m = choose_agreement_radius(
        examples, criteria.tolerance, context.spacing_m, context.finest_side_m
    )
    inside = [consensus_of(one.inside, radius_m, context.finest_side_m) for one in examples]
    strangers = [one for one in examples if one.outside]
    outside = [consensus_of(one.outside, radius_m, context.finest_side_m) for one in strangers]
    right_N = np.array(
        [is_correct(at, one, criteria.tolerance) for at, one in zip(inside, examples, strict=True)]
    )
    if not right_N.any():
        raise InputError(
            f"none of {len(right_N)} photos is answered rightly, expected some; calibrate on more "
            "photos, or check that the photos and --index are of one data set"
        )
    if not strangers:
        raise InputError(
            f"no gallery image lies beyond the surroundings of any of {len(examples)} photos, "
            "expected some, to learn what a photo from elsewhere looks like; calibrate over a "
            "larger gallery"
        )
    hits = [one.inside for one in examples] + [one.outside for one in strangers]
    pairs = zip([*inside, *outside], hits, strict=True)
    x_NF = np.array([confidence_features(at, consensus_scores(best)) for at, best in pairs])
    yes_N = np.concatenate([right_N, np.zeros(len(strangers))])
    weight_N = example_weights(len(examples), len(strangers), criteria.outside)
    both_N = np.array([one.location for one in [*examples, *strangers]], dtype=np.str_)
    p_N = cross_validated_probabilities(x_NF, yes_N, weight_N, both_N)
    bins = reliability_bins(p_N, yes_N, weight_N)
    threshold = youden_threshold(p_N, yes_N, weight_N)
    inverse_temperature, none_log_odds = fit_track_choice(examples, strangers, weight_N)
    return Calibration(
        fingerprint=context.fingerprint,
        gallery_rows=context.gallery_rows,
        photo_selection=context.photo_selection,
        spacing_m=context.spacing_m,
        finest_side_m=context.finest_side_m,
        agreement_radius_m=radius_m,
        tolerance_m=criteria.tolerance,
        outside=criteria.outside,
        model=fit_logistic(x_NF, yes_N, weight_N),
        threshold=threshold,
        inverse_temperature=inverse_temperature,
        none_log_odds=none_log_odds,
        photos=len(examples),
        locations=location_count,
        accuracy=float(right_N.mean()),
        right_kept=float((p_N[yes_N > 0] >= threshold).mean()),
        outside_unknown=float((p_N[len(examples) :] < threshold).mean()),
        calibration_error=expected_calibration_error(bins),
        bins=tuple(bins),
    )


def position_error_m(consensus: Consensus, example: CalibrationExample) -> float | None:
    """Metres from the consensus to the photo's position; None where either is unknown."""
    if consensus.lat is None or consensus.lon is None or example.lat is None or example.lon is None:
        return None
    found_2, true_2 = np.array([consensus.lat, consensus.lon]), np.array([example.lat, example.lon])
    return float(haversine_m(found_2, true_2))


def is_correct(consensus: Consensus, example: CalibrationExample, tolerance_m: float) -> bool:
    """Whether the consensus is of the photo's location, or near enough to its position."""
    if example.inside[consensus.leader].location == example.location:
        return True
    error_m = position_error_m(consensus, example)
    return error_m is not None and error_m <= tolerance_m


def choose_agreement_radius(
    examples: Sequence[CalibrationExample],
    tolerance_m: float,
    spacing_m: float | None,
    finest_side_m: float | None = None,
) -> float:
    """The agreement radius in metres: the smallest of AGREEMENT_FACTORS, unless a larger one
    locates significantly more photos within the tolerance.

    Significantly: more by twice the standard error over locations, as photos of one location
    resemble each other.
    """
    if spacing_m is None:
        return 0.0
    _, location_N = np.unique([one.location for one in examples], return_inverse=True)
    errors = [
        [
            position_error_m(consensus_of(one.inside, factor * spacing_m, finest_side_m), one)
            for one in examples
        ]
        for factor in AGREEMENT_FACTORS
    ]
    within = [[error is not None and error <= tolerance_m for error in row] for row in errors]
    within_AN = np.array(within, np.float64)
    best = 0
    for larger in range(1, len(AGREEMENT_FACTORS)):
        gain_L = np.bincount(location_N, within_AN[larger] - within_AN[best])
        if gain_L.sum() > 2 * np.sqrt((gain_L**2).sum()):
            best = larger
    return AGREEMENT_FACTORS[best] * spacing_m


def example_weights(inside: int, outside: int, share: float) -> Doubles:
    """Weights (inside + outside,) under which the examples from outside are a `share` of all; their
    mean is about 1."""
    weights_2 = 2 * inside * np.array([(1 - share) / inside, share / max(outside, 1)])
    return np.repeat(weights_2, [inside, outside])


def fit_track_choice(
    examples: Sequence[CalibrationExample],
    strangers: Sequence[CalibrationExample],
    weight_N: Doubles,
) -> tuple[float, float]:
    """(inverse_temperature, none_log_odds) of the choice among TRACK_CANDIDATES under which the
    true candidates are likeliest: those of `examples` inside, and of `strangers` outside."""
    rows, chosen = [], []
    hits_of = [one.inside for one in examples] + [one.outside for one in strangers]
    for hits, example in zip(hits_of, [*examples, *strangers], strict=True):
        hits = hits[:TRACK_CANDIDATES]
        x_K = np.full(TRACK_CANDIDATES, -np.inf)
        x_K[: len(hits)] = relative_scores(hits)
        rows.append(x_K)
        true = [rank for rank, hit in enumerate(hits) if hit.location == example.location]
        chosen.append(true[0] if true else TRACK_CANDIDATES)
    return fit_choice_model(np.array(rows), np.array(chosen), weight_N)
