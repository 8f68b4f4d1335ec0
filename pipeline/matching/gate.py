"""Whether a refinement holds, by its inliers and its ellipse.

A rule for all maps; a model that is fitted on photos of known places of one map is to replace it
(docs/decisions.md).
"""

from pipeline.matching.refine import Refinement

LEAST_INLIERS, MOST_ELLIPSE_M = 20, 5.0
"""A refinement of fewer inliers, or of a wider ellipse, is not used. By chance a window gives up to
a dozen."""


def holds(refinement: Refinement) -> bool:
    """Whether a refinement is used."""
    return refinement.inliers >= LEAST_INLIERS and refinement.ellipse.major_m <= MOST_ELLIPSE_M
