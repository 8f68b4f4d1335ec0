"""A calibration with defaults, for tests that need one and fit none."""

from dataclasses import replace
from typing import Any

from pipeline.confidence.logistic import LogisticModel
from pipeline.confidence.reliability import ReliabilityBin
from pipeline.locate.calibration import FEATURE_NAMES, Calibration

ZEROS, ONES = (0.0,) * len(FEATURE_NAMES), (1.0,) * len(FEATURE_NAMES)


def constant_model(log_odds: float) -> LogisticModel:
    """The same probability for every answer."""
    return LogisticModel(mean_F=ZEROS, scale_F=ONES, coefficient_F=ZEROS, intercept=log_odds)


def make_calibration(**changes: Any) -> Calibration:
    """A calibration over a gallery of three rows, 300 m apart; every answer's log-odds are 2."""
    calibration = Calibration(
        fingerprint="f" * 64,
        gallery_rows=3,
        photo_selection="",
        spacing_m=300.0,
        agreement_radius_m=150.0,
        tolerance_m=25.0,
        outside=0.5,
        model=constant_model(2.0),
        threshold=0.4,
        inverse_temperature=20.0,
        none_log_odds=1.0,
        photos=100,
        locations=20,
        accuracy=0.7,
        right_kept=0.8,
        outside_unknown=0.9,
        calibration_error=0.02,
        bins=(ReliabilityBin(predicted=0.1, observed=0.2, share=1.0),),
    )
    return replace(calibration, **changes)
