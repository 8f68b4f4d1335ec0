"""Refinements of photos whose places are known -> the gate.

NumPy only, no I/O. Shapes: N refinements, F features.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.camera.local_plane import LocalPlane
from pipeline.confidence.cross_validation import (
    cross_validated_probabilities,
    wrong_share_threshold,
)
from pipeline.confidence.logistic import fit_logistic
from pipeline.core.arrays import Doubles, Mask, Strings
from pipeline.matching.gate import Gate, beyond_chance, gate_features
from pipeline.matching.refine import Refinement

HELD = 0.95
"Share of the used refinements whose true place the ellipse is to hold."
MOST_WRONG = 0.02
"""Share of the used refinements that may show another place. Not Youden's threshold, which weighs
kept shares of either kind: wrong refinements are few, and to drop one of eight it drops one right
one in ten."""
LEAST_RIGHT = 10
"Right refinements that a gate is fitted on; the ellipse's floor needs as many."
FLOOR_STEPS = 40
"Halvings of the interval that the floor lies in."


@dataclass(frozen=True, kw_only=True)
class GateExamples:
    """Refinements, and where their photos' ground lies in truth."""

    refinements: Sequence[Refinement]
    errors_N2: Doubles
    "True place from the refined one, (east, north) in metres; NaN where unknown."
    weight_N: Doubles
    locations_N: Strings
    "Examples of one location stay together in cross-validation."


def error_of(refinement: Refinement, lat: float, lon: float) -> tuple[float, float]:
    """A true place from the refined one, (east, north) in metres."""
    plane = LocalPlane(lat=refinement.lat, lon=refinement.lon)
    [[east, north]] = plane.to_metres(np.array([[lat, lon]])).tolist()
    return east, north


@dataclass(frozen=True, kw_only=True)
class FittedGate:
    """A gate, and what it says of its examples by models that were fitted without their
    locations."""

    gate: Gate
    admitted_N: Mask
    "Whether each refinement is used."
    p_N: Doubles
    "The probability that its position is right, if it is used."


def fit_gate(examples: GateExamples, within_m: float, place_m: float) -> FittedGate | None:
    """The gate of positions within `within_m`, where a refinement within `place_m` shows the right
    place; None where fewer than LEAST_RIGHT refinements are right, or none would be used."""
    distance_N = np.linalg.norm(examples.errors_N2, axis=1)
    place_N, right_N = distance_N <= place_m, distance_N <= within_m  # NaN gives False
    if right_N.sum() < LEAST_RIGHT:
        return None
    x_NF = np.array([gate_features(one) for one in examples.refinements])
    weight_N, locations_N = examples.weight_N, examples.locations_N
    yes_N = place_N.astype(np.float64)
    place_p_N = cross_validated_probabilities(x_NF, yes_N, weight_N, locations_N)
    # Those of few inliers are never used. The only wrong one is sure of itself in cross-validation,
    # whose models are fitted without it, and no threshold would be high enough.
    enough_N = np.array([beyond_chance(one) for one in examples.refinements])
    threshold = wrong_share_threshold(
        place_p_N[enough_N], yes_N[enough_N], weight_N[enough_N], MOST_WRONG
    )
    admitted_N = (place_p_N >= threshold) & enough_N
    if not (admitted_N & right_N).any():
        return None
    used = (x_NF[admitted_N], right_N[admitted_N].astype(np.float64), weight_N[admitted_N])
    p_N = np.zeros(len(x_NF))
    p_N[admitted_N] = cross_validated_probabilities(*used, locations_N[admitted_N])
    gate = Gate(
        place_model=fit_logistic(x_NF, yes_N, weight_N),
        threshold=threshold,
        within_m=within_m,
        model=fit_logistic(*used),
        floor_m=_ellipse_floor(examples, np.flatnonzero(admitted_N & place_N).tolist()),
    )
    return FittedGate(gate=gate, admitted_N=admitted_N, p_N=p_N)


def _ellipse_floor(examples: GateExamples, used: Sequence[int]) -> float:
    """The least error, beside that of the matches, with which the ellipses of HELD of the used
    refinements hold the true places, metres."""
    pairs = [(examples.refinements[at].ellipse, examples.errors_N2[at].tolist()) for at in used]
    low, high = 0.0, max((float(np.hypot(*error)) for _, error in pairs), default=0.0)
    for _ in range(FLOOR_STEPS):
        middle = (low + high) / 2
        held = sum(ellipse.widened(middle).holds(*error) for ellipse, error in pairs)
        low, high = (low, middle) if held >= HELD * len(pairs) else (middle, high)
    return high
