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

LEAST_INLIERS, MOST_ELLIPSE_M = 12, 5.0
"Without a model: a refinement of fewer inliers, or of a wider ellipse, is not used."
CHANCE_INLIERS = 8
"""Never enough, whatever a model says. Of 240 windows that did not show a photo's ground none gave
a view that a camera can have; one wrong one of eight inliers was seen (docs/decisions.md)."""
LEAST_DENSE_INLIERS, CHANCE_DENSE_INLIERS = 80, 40
"""Of dense features instead, whose points lie close: of 60 windows that did not show a photo's
ground none gave more than 28, of 110 by an earlier head none more than 40."""
LEAST_PROBABILITY = 0.1
"""A refined answer that is less probably right is `unknown`, though the gate lets it pass: it tells
whoever reads it that it is wrong (docs/decisions.md)."""
GATE_FEATURES = (
    "log inliers", "inlier share", "log ellipse", "log residual", "tilt", "promised", "dense",
)  # fmt: skip
SMALLEST_M = 0.01
"Ellipses and residuals below a centimetre are taken for one."


def gate_features(refinement: Refinement) -> Doubles:
    """The features (F,) of GATE_FEATURES that separate right refinements from wrong ones. Tilt is
    the logarithm of the footprint's longest side over its shortest: relief moves what an oblique
    photo shows."""
    corners_42 = np.array(refinement.footprint)
    corners_42[:, 1] *= math.cos(math.radians(refinement.lat))
    side_4 = np.linalg.norm(np.roll(corners_42, -1, axis=0) - corners_42, axis=1)
    return np.array(
        [
            math.log(refinement.inliers),
            refinement.inliers / refinement.matches,
            math.log(min(max(refinement.ellipse.major_m, SMALLEST_M), 1e6)),
            math.log(max(refinement.residual_m, SMALLEST_M)),
            math.log(side_4.max() / max(side_4.min(), 1e-12)),
            float(refinement.promised),
            float(refinement.dense),
        ]
    )


def beyond_chance(refinement: Refinement) -> bool:
    """Whether it has more inliers than wrong views have."""
    most = CHANCE_DENSE_INLIERS if refinement.dense else CHANCE_INLIERS
    return refinement.inliers > most


@dataclass(frozen=True, kw_only=True)
class Gate:
    """Which refinements of one map hold, and how probably they are near the truth."""

    place_model: LogisticModel
    "Of the probability that a refinement shows the right place, by GATE_FEATURES."
    threshold: float
    "Refinements of a lower probability of the right place are not used."
    within_m: float
    "A position counts as right if it is so near to the true one."
    model: LogisticModel
    "Of the probability that a used refinement's position is right, by GATE_FEATURES."
    floor_m: float
    """The error that matches do not tell, relief above all: with it the ellipses held 95 % of the
    true places."""

    def admits(self, refinement: Refinement) -> bool:
        """Whether a refinement is used."""
        [place] = self.place_model.probabilities(gate_features(refinement)[None])
        return beyond_chance(refinement) and bool(place >= self.threshold)

    def probability(self, refinement: Refinement) -> float:
        """Probability that the position of a refinement that is used is right."""
        return float(self.model.probabilities(gate_features(refinement)[None])[0])

    def ellipse(self, refinement: Refinement) -> Ellipse:
        """The refinement's ellipse, as wide as the errors on this map are."""
        return refinement.ellipse.widened(self.floor_m)


def holds(refinement: Refinement, gate: Gate | None = None) -> bool:
    """Whether a refinement is used: by its gate, else by the rule."""
    if gate is not None:
        return gate.admits(refinement)
    least = LEAST_DENSE_INLIERS if refinement.dense else LEAST_INLIERS
    return refinement.inliers >= least and refinement.ellipse.major_m <= MOST_ELLIPSE_M
