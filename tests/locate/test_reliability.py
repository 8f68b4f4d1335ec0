"""Said and seen, worked by hand."""

from xml.etree import ElementTree

import numpy as np
import pytest

from pipeline.locate.reliability import (
    expected_calibration_error,
    reliability_bins,
    reliability_diagram,
)

SAID, TRUE, WEIGHT = (
    np.array([0.12, 0.18, 0.95, 1.0]),
    np.array([0.0, 1, 1, 1]),
    np.array([1.0, 1, 1, 3]),
)


def test_bins_hold_what_was_said_and_seen_by_weight() -> None:
    low, high = reliability_bins(SAID, TRUE, WEIGHT)
    assert (low.predicted, low.observed, low.share) == pytest.approx((0.15, 0.5, 2 / 6))
    assert (high.predicted, high.observed, high.share) == pytest.approx((0.9875, 1, 4 / 6))


def test_the_calibration_error_is_the_mean_distance_of_said_and_seen() -> None:
    assert expected_calibration_error(reliability_bins(SAID, TRUE, WEIGHT)) == pytest.approx(
        (2 * 0.35 + 4 * 0.0125) / 6
    )


def test_probabilities_that_come_true_have_no_error() -> None:
    assert (
        expected_calibration_error(
            reliability_bins(np.array([0.5, 0.5]), np.array([0.0, 1.0]), np.ones(2))
        )
        == 0
    )


def test_the_diagram_is_a_picture_with_a_dot_for_each_bin() -> None:
    drawn = ElementTree.fromstring(
        reliability_diagram(reliability_bins(SAID, TRUE, WEIGHT), "A & B")
    )
    dots = drawn.findall(".//{http://www.w3.org/2000/svg}circle")
    assert len(dots) == 2
    assert drawn.attrib["aria-label"] == "A & B"
