"""Fits a calibration on photos of known locations that the encoder was not trained on.

In: for each photo the candidates that a gallery with its location returns, and those of a gallery
without it, so that the model sees right answers, wrong ones, and photos that match nothing. Out: a
Calibration. Never fitted on the test set, whose figures it would then describe. NumPy only, no I/O.
Shapes: N examples, F features, K candidates, A agreement factors, L locations.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.confidence.logistic import fit_choice_model, fit_logistic
from pipeline.confidence.reliability import expected_calibration_error, reliability_bins
from pipeline.core.arrays import Doubles, Strings
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

CROSS_VALIDATION_FOLDS = 5

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
    "Candidates from a gallery that does not contain it."


@dataclass(frozen=True, kw_only=True)
class CalibrationContext:
    """The encoder, gallery and photos of a calibration, recorded in its file."""

    fingerprint: str
    "Fingerprint of the encoder."
    gallery_rows: int
    spacing_m: float | None
    "Median distance of a gallery position to the next one; None where no two are known."
    photo_selection: str = ""
    "Which photos were searched, in words."


def fit_calibration(
    examples: Sequence[CalibrationExample],
    criteria: CalibrationCriteria,
    context: CalibrationContext,
) -> Calibration:
    """Fit the confidence model, its threshold and the track's choice model.

    Raises InputError where the examples show too few locations, or where all answers are right or
    all wrong.
    """
    locations_N = np.array([one.location for one in examples], dtype=np.str_)
    location_count = len(np.unique(locations_N))
    if location_count < MIN_LOCATIONS:
        raise InputError(
            f"{len(examples)} photos of {location_count} locations to calibrate on, expected at "
            f"least {MIN_LOCATIONS} locations that the encoder was not trained on; train with "
            "--hold-out 0.1, or name another --split"
        )
    radius_m = choose_agreement_radius(examples, criteria.tolerance, context.spacing_m)
    inside = [consensus_of(one.inside, radius_m) for one in examples]
    outside = [consensus_of(one.outside, radius_m) for one in examples]
    right_N = np.array(
        [is_correct(at, one, criteria.tolerance) for at, one in zip(inside, examples, strict=True)]
    )
    if right_N.all() or not right_N.any():
        raise InputError(
            f"{right_N.sum()} of {len(right_N)} photos are answered rightly, expected some right "
            "and some wrong; calibrate on more photos, or check that --shards and --index are of "
            "one data set"
        )
    hits = [one.inside for one in examples] + [one.outside for one in examples]
    pairs = zip([*inside, *outside], hits, strict=True)
    x_NF = np.array([confidence_features(at, consensus_scores(best)) for at, best in pairs])
    yes_N = np.concatenate([right_N, np.zeros(len(examples))])
    weight_N = 2 * np.repeat([1 - criteria.outside, criteria.outside], len(examples))
    p_N = cross_validated_probabilities(x_NF, yes_N, weight_N, np.tile(locations_N, 2))
    bins = reliability_bins(p_N, yes_N, weight_N)
    threshold = youden_threshold(p_N, yes_N, weight_N)
    inverse_temperature, none_log_odds = fit_track_choice(examples, weight_N)
    return Calibration(
        fingerprint=context.fingerprint,
        gallery_rows=context.gallery_rows,
        photo_selection=context.photo_selection,
        spacing_m=context.spacing_m,
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
    examples: Sequence[CalibrationExample], tolerance_m: float, spacing_m: float | None
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
        [position_error_m(consensus_of(one.inside, factor * spacing_m), one) for one in examples]
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


def cross_validated_probabilities(
    x_NF: Doubles, yes_N: Doubles, weight_N: Doubles, locations_N: Strings
) -> Doubles:
    """Each example's probability (N,) by a model that was fitted without its location."""
    folds = {
        name: hashlib.sha256(name.encode()).digest()[0] % CROSS_VALIDATION_FOLDS
        for name in np.unique(locations_N).tolist()
    }
    fold_N = np.array([folds[name] for name in locations_N.tolist()])
    p_N = np.empty(len(x_NF))
    for fold in np.unique(fold_N):
        left_out_N = fold_N == fold
        model = fit_logistic(x_NF[~left_out_N], yes_N[~left_out_N], weight_N[~left_out_N])
        p_N[left_out_N] = model.probabilities(x_NF[left_out_N])
    return p_N


def youden_threshold(p_N: Doubles, yes_N: Doubles, weight_N: Doubles) -> float:
    """The lowest probability to answer at: there the share of right answers kept, less the share of
    wrong answers kept, is greatest (Youden 1950). Each share is of its own kind's total, so that
    neither kind is given up for being rare."""
    order_N = np.argsort(-p_N, kind="stable")
    right_N, wrong_N = (weight_N * yes_N)[order_N], (weight_N * (1 - yes_N))[order_N]
    gain_N = np.cumsum(right_N) / right_N.sum() - np.cumsum(wrong_N) / wrong_N.sum()
    return float(p_N[order_N][int(np.argmax(gain_N))])


def fit_track_choice(
    examples: Sequence[CalibrationExample], weight_N: Doubles
) -> tuple[float, float]:
    """(inverse_temperature, none_log_odds) of the choice among TRACK_CANDIDATES under which the
    true candidates are likeliest."""
    rows, chosen = [], []
    inside, outside = [one.inside for one in examples], [one.outside for one in examples]
    for hits, example in zip([*inside, *outside], [*examples, *examples], strict=True):
        hits = hits[:TRACK_CANDIDATES]
        x_K = np.full(TRACK_CANDIDATES, -np.inf)
        x_K[: len(hits)] = relative_scores(hits)
        rows.append(x_K)
        true = [rank for rank, hit in enumerate(hits) if hit.location == example.location]
        chosen.append(true[0] if true else TRACK_CANDIDATES)
    return fit_choice_model(np.array(rows), np.array(chosen), weight_N)
