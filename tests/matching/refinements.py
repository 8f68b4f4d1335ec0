"""A refinement with defaults, for tests that match nothing."""

from dataclasses import replace
from typing import Any

from pipeline.camera.uncertainty import Ellipse
from pipeline.matching.refine import Refinement

METRE_LAT = 1 / 111_150.0
"Degrees of latitude of a metre at 46 degrees north."


def make_refinement(**changes: Any) -> Refinement:
    """A photo that looks north at 46 N, 8 E, of 50 inliers among 100 matches."""
    refinement = Refinement(
        lat=46.0,
        lon=8.0,
        ellipse=Ellipse(major_m=1.0, minor_m=0.5, direction_deg=0.0),
        heading_deg=0.0,
        footprint=((46.001, 7.999), (46.001, 8.001), (45.999, 8.001), (45.999, 7.999)),
        camera=None,
        inliers=50,
        matches=100,
        residual_m=0.2,
        promised=False,
    )
    return replace(refinement, **changes)
