"""Photos of known places that were matched with the map -> the part of a calibration that knows of
matching.

In: answers of retrieval with refinements, from a gallery and windows that show the photos' places,
and from such that do not. Out: a `MatchingCalibration`. NumPy only, no I/O.
Shapes: N examples, F features.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.confidence.cross_validation import (
    UNDECIDED,
    cross_validated_probabilities,
    youden_threshold,
)
from pipeline.confidence.logistic import fit_logistic
from pipeline.confidence.reliability import expected_calibration_error, reliability_bins
from pipeline.core.arrays import Doubles, Mask
from pipeline.core.errors import InputError
from pipeline.locate.calibration import Calibration, MatchingCalibration, confidence_features
from pipeline.locate.fitting.calibrate import CalibrationExample, example_weights, is_correct
from pipeline.locate.locate import consensus_of, consensus_scores
from pipeline.matching.fit_gate import LEAST_RIGHT, GateExamples, error_of, fit_gate
from pipeline.matching.gate import LEAST_PROBABILITY
from pipeline.matching.refine import Refinement


@dataclass(frozen=True, kw_only=True)
class MatchedExample:
    """A photo of a known place, with what matching makes of it."""

    searched: CalibrationExample
    inside: Refinement | None
    "By windows around the candidates of the gallery that contains its place."
    outside: Refinement | None
    """By windows around candidates from elsewhere. Right where such a window shows its place after
    all: an oblique photo shows ground far ahead."""


def fit_matching(
    examples: Sequence[MatchedExample], calibration: Calibration, within_m: float
) -> MatchingCalibration:
    """Fit the gate, and the probability of tiles for photos that it lets no refinement pass for.

    Raises InputError where too few refinements are right.
    """
    strangers = [one for one in examples if one.searched.outside]
    both = [(one, True) for one in examples] + [(one, False) for one in strangers]
    weight_N = example_weights(len(examples), len(strangers), calibration.outside)
    locations_N = np.array([one.searched.location for one, _ in both], dtype=np.str_)
    found = [one.inside if inside else one.outside for one, inside in both]
    refined = [at for at, refinement in enumerate(found) if refinement is not None]
    gate_examples = GateExamples(
        refinements=[refinement for refinement in found if refinement is not None],
        errors_N2=np.array([_error(*both[at]) for at in refined]).reshape(-1, 2),
        weight_N=weight_N[refined],
        locations_N=locations_N[refined],
    )
    fitted = fit_gate(gate_examples, within_m, calibration.tolerance_m)
    if fitted is None:
        raise InputError(
            f"fewer than {LEAST_RIGHT} of {len(examples)} photos are matched within {within_m:g} m "
            "of their true place, or wrong matches look surer, expected more to fit a gate on; "
            "calibrate on more photos, check their positions, or give a larger --within"
        )
    gate = fitted.gate
    p_N, right_N = np.zeros(len(both)), np.zeros(len(both))
    p_N[refined] = fitted.p_N
    right_N[refined] = np.linalg.norm(gate_examples.errors_N2, axis=1) <= within_m
    tiles_N = np.ones(len(both), np.bool_)
    tiles_N[refined] = ~fitted.admitted_N
    x_NF = np.array([_tile_features(*one, calibration) for one in both])
    right_N[tiles_N] = np.array([_tile_is_right(*one, calibration) for one in both])[tiles_N]
    tile_model, tile_threshold = calibration.model, calibration.threshold
    if tiles_N.any():
        rest = (x_NF[tiles_N], right_N[tiles_N], weight_N[tiles_N])
        p_N[tiles_N] = cross_validated_probabilities(*rest, locations_N[tiles_N])
        tile_model = fit_logistic(*rest)
        # These photos found no place of their own on the map: rather unknown than wrong.
        tile_threshold = max(youden_threshold(p_N[tiles_N], *rest[1:]), UNDECIDED)
    bins = reliability_bins(p_N, right_N, weight_N)
    known_N: Mask = p_N >= np.where(tiles_N, tile_threshold, LEAST_PROBABILITY)
    inside_N = np.array([inside for _, inside in both])
    return MatchingCalibration(
        gate=gate,
        tile_model=tile_model,
        tile_threshold=tile_threshold,
        photos=len(examples),
        refined=float((~tiles_N & (right_N > 0))[inside_N].mean()),
        known=float(known_N[inside_N].mean()),
        known_right=float(right_N[inside_N & known_N].mean()),
        outside_unknown=float((~known_N[~inside_N & (right_N == 0)]).mean()),
        calibration_error=expected_calibration_error(bins),
        bins=tuple(bins),
    )


def _error(example: MatchedExample, inside: bool) -> tuple[float, float]:
    place, refinement = example.searched, example.inside if inside else example.outside
    if refinement is None or place.lat is None or place.lon is None:
        return np.nan, np.nan
    return error_of(refinement, place.lat, place.lon)


def _tile_features(example: MatchedExample, inside: bool, calibration: Calibration) -> Doubles:
    hits = example.searched.inside if inside else example.searched.outside
    consensus = consensus_of(hits, calibration.agreement_radius_m, calibration.finest_side_m)
    return confidence_features(consensus, consensus_scores(hits))


def _tile_is_right(example: MatchedExample, inside: bool, calibration: Calibration) -> bool:
    if not inside:
        return False
    consensus = consensus_of(
        example.searched.inside, calibration.agreement_radius_m, calibration.finest_side_m
    )
    return is_correct(consensus, example.searched, calibration.tolerance_m)
