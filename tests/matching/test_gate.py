"""The fitted gate: its probability follows the inliers, its ellipse the errors."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.camera.uncertainty import Ellipse
from pipeline.matching.fit_gate import LEAST_RIGHT, GateExamples, error_of, fit_gate
from pipeline.matching.gate import CHANCE_INLIERS, holds
from tests.matching.refinements import METRE_LAT, make_refinement


def examples(count: int = 200) -> GateExamples:
    """Half are right and have 30 to 200 inliers and an error of twice their ellipse, the others are
    a kilometre off and have 8 to 15."""
    rng = np.random.default_rng(0)
    right = np.arange(count) % 2 == 0
    inliers = np.where(right, rng.integers(30, 200, count), rng.integers(8, 16, count))
    return GateExamples(
        refinements=[make_refinement(inliers=int(one)) for one in inliers],
        errors_N2=np.where(right[:, None], [[1.0, 0.0]], [[1000.0, 0.0]]),
        weight_N=np.ones(count),
        locations_N=np.array([f"p{n}" for n in range(count)], dtype=np.str_),
    )


def test_gate_separates_by_inliers() -> None:
    fitted = fit_gate(examples(), within_m=5.0, place_m=25.0)
    assert fitted is not None
    assert fitted.admitted_N[::2].mean() > 0.95
    assert fitted.admitted_N[1::2].mean() < 0.05
    assert fitted.p_N[fitted.admitted_N].mean() > 0.95
    gate = fitted.gate
    assert gate.probability(make_refinement(inliers=100)) > 0.95
    assert holds(make_refinement(inliers=100), gate)
    assert not holds(make_refinement(inliers=10), gate)


def test_gate_keeps_right_places_that_are_not_near_enough() -> None:
    """Nine in ten of the right places are within a metre and the others 8 m off, which nothing
    tells beforehand: all are used, at nine in ten."""
    given = examples()
    given.errors_N2[::20] = [8.0, 0.0]
    fitted = fit_gate(given, within_m=5.0, place_m=25.0)
    assert fitted is not None
    assert fitted.admitted_N[::2].mean() > 0.95
    assert fitted.p_N[fitted.admitted_N].mean() == pytest.approx(0.9, abs=0.03)


def test_gate_of_right_examples_only_still_asks_for_inliers() -> None:
    given = examples()
    right = GateExamples(
        refinements=given.refinements[::2],
        errors_N2=given.errors_N2[::2],
        weight_N=given.weight_N[::2],
        locations_N=given.locations_N[::2],
    )
    fitted = fit_gate(right, within_m=5.0, place_m=25.0)
    assert fitted is not None
    assert fitted.admitted_N.all()
    assert not holds(make_refinement(inliers=CHANCE_INLIERS), fitted.gate)


def test_gate_outlives_a_wrong_one_that_looks_sure() -> None:
    """Of 41 examples one is wrong: models without it know no wrong ones. By too few inliers it is
    never used; with more it leaves none to use."""
    given = examples(82)
    few = GateExamples(
        refinements=[*given.refinements[::2], make_refinement(inliers=8, residual_m=0.0)],
        errors_N2=np.vstack([given.errors_N2[::2], [1000.0, 0.0]]),
        weight_N=np.ones(42),
        locations_N=np.append(given.locations_N[::2], "p2"),
    )
    fitted = fit_gate(few, within_m=5.0, place_m=25.0)
    assert fitted is not None
    assert fitted.admitted_N.tolist() == [True] * 41 + [False]
    sure = [*few.refinements[:-1], make_refinement(inliers=900, residual_m=0.0)]
    assert fit_gate(replace(few, refinements=sure), within_m=5.0, place_m=25.0) is None


def test_gate_ellipse_holds_the_errors() -> None:
    """Errors of 1 m to the east and ellipses of half a metre there."""
    fitted = fit_gate(examples(), within_m=5.0, place_m=25.0)
    assert fitted is not None
    assert fitted.gate.floor_m == pytest.approx(0.75**0.5)
    assert fitted.gate.ellipse(make_refinement(inliers=50)).minor_m == pytest.approx(1.0)


def test_gate_needs_right_refinements() -> None:
    few = examples(2 * LEAST_RIGHT - 2)
    assert fit_gate(few, within_m=5.0, place_m=25.0) is None
    assert fit_gate(few, within_m=0.5, place_m=25.0) is None


def test_ellipse_holds_by_hand() -> None:
    ellipse = Ellipse(major_m=3.0, minor_m=1.0, direction_deg=90.0)
    assert ellipse.holds(2.9, 0.0)
    assert not ellipse.holds(3.1, 0.0)
    assert not ellipse.holds(0.0, 1.1)
    assert ellipse.widened(4.0).holds(4.9, 0.0)
    assert not Ellipse(major_m=0.0, minor_m=0.0, direction_deg=0.0).holds(1, 1)


def test_error_of_refinement_in_metres() -> None:
    refinement = make_refinement(inliers=50)
    error = error_of(refinement, refinement.lat + 10 * METRE_LAT, refinement.lon)
    assert np.allclose(error, [0, 10], rtol=0.01, atol=1e-6)
