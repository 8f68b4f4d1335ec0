"""Refinements of photos whose places are known -> the gate.

NumPy only, no I/O. Shapes: N refinements, F features.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.camera.local_plane import LocalPlane
from pipeline.confidence.cross_validation import cross_validated_probabilities, youden_threshold
from pipeline.confidence.logistic import fit_logistic
from pipeline.core.arrays import Doubles, Strings
from pipeline.matching.gate import Gate, gate_features
from pipeline.matching.refine import Refinement

HELD = 0.95
"Share of the right refinements whose place the ellipse is to hold."
LEAST_RIGHT = 10
"Right refinements that a gate is fitted on; the ellipse's scale needs as many."


@dataclass(frozen=True, kw_only=True)
class GateExamples:
    """Refinements, and where their photos' ground lies in truth."""

    refinements: Sequence[Refinement]
    errors_N2: Doubles
    "True place from the refined one, (east, north) in metres; NaN: none of the windows shows it."
    weight_N: Doubles
    locations_N: Strings
    "Examples of one location stay together in cross-validation."


def error_of(refinement: Refinement, lat: float, lon: float) -> tuple[float, float]:
    """A true place from the refined one, (east, north) in metres."""
    plane = LocalPlane(lat=refinement.lat, lon=refinement.lon)
    [[east, north]] = plane.to_metres(np.array([[lat, lon]])).tolist()
    return east, north


def fit_gate(examples: GateExamples, within_m: float) -> tuple[Gate, Doubles] | None:
    """The gate, and the probability (N,) of each example by a model that was fitted without its
    location; None where fewer than LEAST_RIGHT refinements are right."""
    distance_N = np.hypot(examples.errors_N2[:, 0], examples.errors_N2[:, 1])
    right_N = distance_N <= within_m  # NaN gives False
    if right_N.sum() < LEAST_RIGHT:
        return None
    x_NF = np.array([gate_features(one) for one in examples.refinements])
    yes_N, weight_N = right_N.astype(np.float64), examples.weight_N
    p_N = cross_validated_probabilities(x_NF, yes_N, weight_N, examples.locations_N)
    gate = Gate(
        within_m=within_m,
        model=fit_logistic(x_NF, yes_N, weight_N),
        threshold=youden_threshold(p_N, yes_N, weight_N),
        ellipse_scale=_ellipse_scale(examples, right_N.nonzero()[0].tolist()),
    )
    return gate, p_N


def _ellipse_scale(examples: GateExamples, right: Sequence[int]) -> float:
    """The quantile HELD of the factors by which the right refinements' ellipses must grow."""
    scales = [
        examples.refinements[at].ellipse.scale_to_hold(*examples.errors_N2[at].tolist())
        for at in right
    ]
    return float(np.quantile(scales, HELD, method="higher"))
