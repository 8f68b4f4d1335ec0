"""Photos of known places that the network was not trained on -> how sure its answers are.

In: for each photo what the gallery answers, and what it answers when the photo's own place is taken
out: so the model sees right answers, wrong ones, and photos that nothing fits. Out: a Confidence.
Never from the test set, whose figures it judges. NumPy only, no I/O. Shapes: N examples, F
features, K candidates.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.core.arrays import Doubles
from pipeline.core.errors import InputError
from pipeline.core.geo import haversine_m
from pipeline.index.searcher import Hit
from pipeline.locate.calibration import Calibration, confidence_features
from pipeline.locate.consensus import Consensus
from pipeline.locate.locate import consensus_of, consensus_scores, relative_scores
from pipeline.locate.logistic import fit_choice_model, fit_logistic
from pipeline.locate.reliability import expected_calibration_error, reliability_bins
from pipeline.locate.track import TRACK_CANDIDATES

AGREEMENT_FACTORS = (0.5, 1.5, 2.5)
"""Of the gallery's spacing: how far apart candidates may lie that agree. 0.5: only images of one
place; 1.5: the neighbours on a grid, diagonal ones too; 2.5: two steps away. Which is best depends
on whether neighbouring images overlap."""
CROSS_VALIDATION_FOLDS = 5
MIN_LOCATIONS = 10
"Fewer say nothing of places never seen."


@dataclass(frozen=True, kw_only=True)
class CalibrationExample:
    """A photo of a known place, and what the gallery answers."""

    location: str
    lat: float | None
    "Of the place that the photo shows; None where unknown."
    lon: float | None
    inside: tuple[Hit, ...]
    "Candidates, best first, from a gallery that holds the place."
    outside: tuple[Hit, ...]
    "The same from a gallery that does not."


@dataclass(frozen=True, kw_only=True)
class CalibrationCriteria:
    """What counts as right, and what is expected of photos to come."""

    tolerance: float = 25.0
    "Metres within which a position is right."
    outside: float = 0.5
    "Share of photos to come that will show no place of the gallery. Probabilities depend on it."

    def __post_init__(self) -> None:
        if not self.tolerance > 0:
            raise InputError(f"--tolerance is {self.tolerance}, expected metres above 0")
        if not 0 < self.outside < 1:
            raise InputError(f"--outside is {self.outside}, expected a share above 0 and below 1")


@dataclass(frozen=True, kw_only=True)
class CalibrationContext:
    """What was asked, as the calibration says it of itself."""

    fingerprint: str
    "Of the network that made it."
    rows: int
    spacing_m: float | None
    "Median distance of a position to the next one; None where no two are known."
    asked: str = ""
    "Which photos it was asked for, in words."


def fit_calibration(
    examples: Sequence[CalibrationExample],
    judging: CalibrationCriteria,
    gallery: CalibrationContext,
) -> Calibration:
    """Fit what these examples teach.

    Raises InputError where they show too few places, or where all answers are right or all wrong.
    """
    locations = np.array([one.location for one in examples], dtype=np.str_)
    count = len(np.unique(locations))
    if count < MIN_LOCATIONS:
        raise InputError(
            f"{len(examples)} photos of {count} locations to calibrate on, expected at least {MIN_LOCATIONS} locations that "
            "the network was not trained on; train with --hold-out 0.1, or name another --split"
        )
    agreement_radius_m = choose_agreement_radius(examples, judging.tolerance, gallery.spacing_m)
    inside = [consensus_of(one.inside, agreement_radius_m) for one in examples]
    outside = [consensus_of(one.outside, agreement_radius_m) for one in examples]
    right_N = np.array(
        [
            is_correct(agreed, one, judging.tolerance)
            for agreed, one in zip(inside, examples, strict=True)
        ]
    )
    if right_N.all() or not right_N.any():
        raise InputError(
            f"{right_N.sum()} of {len(right_N)} photos are answered rightly, expected some right and some wrong; calibrate on "
            "more photos, or check that --shards and --index are of one data set"
        )
    hits_N = [one.inside for one in examples] + [one.outside for one in examples]
    x_NF = np.array(
        [
            confidence_features(agreed, consensus_scores(hits))
            for agreed, hits in zip([*inside, *outside], hits_N, strict=True)
        ]
    )
    yes_N = np.concatenate([right_N, np.zeros(len(examples))])
    weight_N = 2 * np.repeat([1 - judging.outside, judging.outside], len(examples))
    said_N = cross_validated_probabilities(x_NF, yes_N, weight_N, np.tile(locations, 2))
    bins = reliability_bins(said_N, yes_N, weight_N)
    threshold = youden_threshold(said_N, yes_N, weight_N)
    inverse_temperature, elsewhere = fit_track_choice(examples, weight_N)
    return Calibration(
        fingerprint=gallery.fingerprint,
        gallery=gallery.rows,
        asked=gallery.asked,
        spacing_m=gallery.spacing_m,
        agreement_radius_m=agreement_radius_m,
        tolerance_m=judging.tolerance,
        outside=judging.outside,
        model=fit_logistic(x_NF, yes_N, weight_N),
        threshold=threshold,
        inverse_temperature=inverse_temperature,
        elsewhere=elsewhere,
        photos=len(examples),
        locations=count,
        right=float(right_N.mean()),
        right_kept=float((said_N[yes_N > 0] >= threshold).mean()),
        outside_unknown=float((said_N[len(examples) :] < threshold).mean()),
        calibration_error=expected_calibration_error(bins),
        bins=tuple(bins),
    )


def position_error_m(agreed: Consensus, example: CalibrationExample) -> float | None:
    """Metres from the place to where the photo's lies; None where either is unknown."""
    if agreed.lat is None or agreed.lon is None or example.lat is None or example.lon is None:
        return None
    return float(
        haversine_m(np.array([agreed.lat, agreed.lon]), np.array([example.lat, example.lon]))
    )


def is_correct(agreed: Consensus, example: CalibrationExample, tolerance_m: float) -> bool:
    """Whether the place is the photo's location, or lies near enough to its position."""
    away = position_error_m(agreed, example)
    return example.inside[agreed.leader].location == example.location or (
        away is not None and away <= tolerance_m
    )


def choose_agreement_radius(
    examples: Sequence[CalibrationExample], tolerance_m: float, spacing_m: float | None
) -> float:
    """How far apart agreeing candidates may lie: the smallest of FACTORS, unless a larger one
    places surely more photos within the tolerance: more by twice the standard error over locations,
    as photos of one place resemble each other."""
    if spacing_m is None:
        return 0.0
    _, location_N = np.unique([one.location for one in examples], return_inverse=True)
    errors = [
        [position_error_m(consensus_of(one.inside, factor * spacing_m), one) for one in examples]
        for factor in AGREEMENT_FACTORS
    ]
    placed_FN = np.array(
        [[error is not None and error <= tolerance_m for error in row] for row in errors],
        np.float64,
    )
    best = 0
    for larger in range(1, len(AGREEMENT_FACTORS)):
        gain_L = np.bincount(location_N, placed_FN[larger] - placed_FN[best])
        if gain_L.sum() > 2 * np.sqrt((gain_L**2).sum()):
            best = larger
    return AGREEMENT_FACTORS[best] * spacing_m


def cross_validated_probabilities(
    x_NF: Doubles, yes_N: Doubles, weight_N: Doubles, locations_N: npt.NDArray[np.str_]
) -> Doubles:
    """Each example's probability by a model that has seen nothing of its location."""
    folds = {
        name: hashlib.sha256(name.encode()).digest()[0] % CROSS_VALIDATION_FOLDS
        for name in np.unique(locations_N).tolist()
    }
    fold_N = np.array([folds[name] for name in locations_N.tolist()])
    said_N = np.empty(len(x_NF))
    for fold in np.unique(fold_N):
        out_N = fold_N == fold
        said_N[out_N] = fit_logistic(x_NF[~out_N], yes_N[~out_N], weight_N[~out_N]).probabilities(
            x_NF[out_N]
        )
    return said_N


def youden_threshold(said_N: Doubles, yes_N: Doubles, weight_N: Doubles) -> float:
    """The probability from which on to answer: the share of right answers kept less that of others
    kept is greatest there (Youden 1950). Either kind counts by its own number, so neither is given
    up for being rare."""
    order_N = np.argsort(-said_N, kind="stable")
    right_N, wrong_N = weight_N * yes_N, weight_N * (1 - yes_N)
    kept_N = (
        np.cumsum(right_N[order_N]) / right_N.sum() - np.cumsum(wrong_N[order_N]) / wrong_N.sum()
    )
    return float(said_N[order_N][int(np.argmax(kept_N))])


def fit_track_choice(
    examples: Sequence[CalibrationExample], weight_N: Doubles
) -> tuple[float, float]:
    """(sharpness, elsewhere) of the choice among TRACKED candidates under which the true ones are
    likeliest.
    """
    rows, chosen = [], []
    for hits, example in [(one.inside, one) for one in examples] + [
        (one.outside, one) for one in examples
    ]:
        x_K = np.full(TRACK_CANDIDATES, -np.inf)
        x_K[: len(hits)] = relative_scores(hits)[:TRACK_CANDIDATES]
        rows.append(x_K)
        true = [
            number
            for number, hit in enumerate(hits[:TRACK_CANDIDATES])
            if hit.location == example.location
        ]
        chosen.append(true[0] if true else TRACK_CANDIDATES)
    return fit_choice_model(np.array(rows), np.array(chosen), weight_N)
