"""The calibration of an index,
damaged by flipped bits, zeroed blocks, truncation and removal: rejected, or read as it was.
"""

from pathlib import Path

from pipeline.confidence.logistic import LogisticModel
from pipeline.locate.calibration import read_calibration, write_calibration
from tests.damaging import count_detected, raising_if_missing
from tests.locate.calibrations import make_calibration


def test_calibration_damaged_is_rejected(tmp_path: Path) -> None:
    model = LogisticModel(
        mean_F=(0.1, 0.2, 0.3, 0.4),
        scale_F=(1.0,) * 4,
        coefficient_F=(1.5, 2.5, 3.5, 4.5),
        intercept=0.25,
    )
    calibration = make_calibration(model=model)
    path = tmp_path / "calibration.json"
    write_calibration(str(path), calibration)
    look = raising_if_missing(path, lambda: read_calibration(str(path), "f" * 64))
    assert count_detected(path, look, 400) > 300
