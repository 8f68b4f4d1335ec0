"""The calibration of an index,
damaged by flipped bits, zeroed blocks, truncation and removal: rejected, or read as it was.
"""

from pathlib import Path

from pipeline.locate.calibration import Calibration, read_calibration, write_calibration
from pipeline.locate.logistic import LogisticModel
from pipeline.locate.reliability import ReliabilityBin
from tests.damaging import (
    count_detected,
    raising_if_missing,
)


def test_calibration_damaged_is_rejected(tmp_path: Path) -> None:
    model = LogisticModel(
        mean_F=(0.1, 0.2, 0.3, 0.4),
        scale_F=(1.0,) * 4,
        coefficient_F=(1.5, 2.5, 3.5, 4.5),
        intercept=0.25,
    )
    calibration = Calibration(
        fingerprint="f" * 64,
        gallery_rows=5,
        photo_selection="places held out",
        spacing_m=10.0,
        agreement_radius_m=5.0,
        tolerance_m=3.0,
        outside=0.5,
        model=model,
        threshold=0.5,
        inverse_temperature=9.0,
        none_log_odds=0.1,
        photos=3,
        locations=2,
        accuracy=0.7,
        right_kept=0.6,
        outside_unknown=0.8,
        calibration_error=0.02,
        bins=(ReliabilityBin(predicted=0.5, observed=0.4, share=1.0),),
    )
    path = tmp_path / "calibration.json"
    write_calibration(str(path), calibration)
    look = raising_if_missing(path, lambda: read_calibration(str(path), "f" * 64))
    assert count_detected(path, look, 400) > 300
