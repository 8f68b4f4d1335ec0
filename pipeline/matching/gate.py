"""Whether a refinement holds: by a model that was fitted on photos of known places of the map, else
by a rule for all maps.

Shapes: F features.
"""

import math
from dataclasses import dataclass

import numpy as np

from pipeline.camera.uncertainty import Ellipse
from pipeline.confidence.logistic import LogisticModel
from pipeline.core.arrays import Doubles
from pipeline.matching.refine import Refinement

LEAST_INLIERS, MOST_ELLIPSE_M = 20, 5.0
"""Without a model: a refinement of fewer inliers, or of a wider ellipse, is not used. By chance a
window gives up to a dozen."""
GATE_FEATURES = ("log inliers", "inlier share", "log ellipse", "log residual", "promised")
SMALLEST_M = 0.01
"Ellipses and residuals below a centimetre are taken for one."


def gate_features(refinement: Refinement) -> Doubles:
    """The features (F,) of GATE_FEATURES that separate right refinements from wrong ones."""
    return np.array(
        [
            math.log(refinement.inliers),
            refinement.inliers / refinement.matches,
            math.log(min(max(refinement.ellipse.major_m, SMALLEST_M), 1e6)),
            math.log(max(refinement.residual_m, SMALLEST_M)),
            float(refinement.promised),
        ]
    )


@dataclass(frozen=True, kw_only=True)
class Gate:
    """Which refinements of one map hold, and how probably."""

    within_m: float
    "A refinement is right if the ground that it names is so near to the true one."
    model: LogisticModel
    "Of the probability that a refinement is right, by GATE_FEATURES."
    threshold: float
    "Refinements of a lower probability are not used."
    ellipse_scale: float
    "The factor by which the ellipses had to grow to hold 95 % of the right refinements' places."

    def probability(self, refinement: Refinement) -> float:
        """Probability that the refinement is right."""
        return float(self.model.probabilities(gate_features(refinement)[None])[0])

    def ellipse(self, refinement: Refinement) -> Ellipse:
        """The refinement's ellipse, as wide as the errors on this map are."""
        return refinement.ellipse.scaled(self.ellipse_scale)


def holds(refinement: Refinement, gate: Gate | None = None) -> bool:
    """Whether a refinement is used."""
    if gate is not None:
        return gate.probability(refinement) >= gate.threshold
    return refinement.inliers >= LEAST_INLIERS and refinement.ellipse.major_m <= MOST_ELLIPSE_M
