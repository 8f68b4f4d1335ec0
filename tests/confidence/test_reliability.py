"""Reliability bins and the expected calibration error by hand."""

from xml.etree import ElementTree

import numpy as np
import pytest

from pipeline.confidence.reliability import (
    expected_calibration_error,
    reliability_bins,
    reliability_diagram,
)

SAID, TRUE, WEIGHT = (
    np.array([0.12, 0.18, 0.95, 1.0]),
    np.array([0.0, 1, 1, 1]),
    np.array([1.0, 1, 1, 3]),
)


def test_reliability_bins_by_hand() -> None:
    low, high = reliability_bins(SAID, TRUE, WEIGHT)
    assert (low.predicted, low.observed, low.share) == pytest.approx((0.15, 0.5, 2 / 6))
    assert (high.predicted, high.observed, high.share) == pytest.approx((0.9875, 1, 4 / 6))


def test_expected_calibration_error_by_hand() -> None:
    assert expected_calibration_error(reliability_bins(SAID, TRUE, WEIGHT)) == pytest.approx(
        (2 * 0.35 + 4 * 0.0125) / 6
    )


def test_expected_calibration_error_of_calibrated_is_0() -> None:
    assert (
        expected_calibration_error(
            reliability_bins(np.array([0.5, 0.5]), np.array([0.0, 1.0]), np.ones(2))
        )
        == 0
    )


def test_reliability_diagram_has_a_dot_per_bin() -> None:
    drawn = ElementTree.fromstring(
        reliability_diagram(reliability_bins(SAID, TRUE, WEIGHT), "A & B")
    )
    dots = drawn.findall(".//{http://www.w3.org/2000/svg}circle")
    assert len(dots) == 2
    assert drawn.attrib["aria-label"] == "A & B"
