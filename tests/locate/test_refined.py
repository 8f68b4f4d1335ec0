"""Answers at refined places: probability, ellipse, and what a refinement that does not hold says of
the tile."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.core.errors import InputError
from pipeline.core.records import View
from pipeline.index.searcher import Hit
from pipeline.locate.calibration import Calibration, read_calibration, write_calibration
from pipeline.locate.fitting.calibrate import CalibrationExample
from pipeline.locate.fitting.fit_matching import MatchedExample, fit_matching
from pipeline.locate.locate import answers_from_hits
from pipeline.locate.refined import with_refinement
from pipeline.matching.gate import LEAST_PROBABILITY
from tests.locate.calibrations import make_calibration
from tests.matching.refinements import METRE_LAT, make_refinement

LOCATIONS = 60


def hits(near: bool, rng: np.random.Generator) -> tuple[Hit, ...]:
    """Ten tiles 300 m apart; the first is the photo's where `near`."""
    scores = np.sort(rng.uniform(0.2, 0.3, 10))[::-1] + (0.4 if near else 0) * (np.arange(10) == 0)
    return tuple(
        Hit(
            key=f"t{n}", location=f"t{n}", view=View.SATELLITE, score=float(score),
            lat=46 + (n + (not near)) * 300 * METRE_LAT, lon=8.0,
        )
        for n, score in enumerate(scores)
    )  # fmt: skip


def matched(count: int = LOCATIONS) -> list[MatchedExample]:
    """Two photos in three are refined to 1 m; of the others the tile is right. From outside comes
    no refinement, or one of few inliers."""
    rng = np.random.default_rng(1)
    examples = []
    for n in range(count):
        searched = CalibrationExample(
            location=f"p{n}", lat=46.0 + METRE_LAT, lon=8.0,
            inside=hits(True, rng), outside=hits(False, rng),
        )  # fmt: skip
        inside = make_refinement(inliers=int(rng.integers(30, 90))) if n % 3 else None
        chance = make_refinement(inliers=int(rng.integers(8, 14)), lon=8.01)
        outside = chance if n % 2 else None
        examples.append(MatchedExample(searched=searched, inside=inside, outside=outside))
    return examples


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    plain = make_calibration()
    return replace(plain, matching=fit_matching(matched(), plain, within_m=5.0))


def test_matching_calibration_figures(calibration: Calibration) -> None:
    matching = calibration.matching
    assert matching is not None
    assert matching.refined == pytest.approx(2 / 3)
    assert matching.known == matching.known_right == matching.outside_unknown == 1
    assert matching.calibration_error < 0.1
    assert matching.photos == LOCATIONS


def test_matching_calibration_counts_hardly_right_as_unknown() -> None:
    """The right place, 8 m off: the gate lets it pass, and knows it by its residual."""
    off = [
        replace(one, inside=make_refinement(residual_m=3.0, lat=46.0 + 9 * METRE_LAT))
        if n % 3 == 1
        else one
        for n, one in enumerate(matched())
    ]
    found = fit_matching(off, make_calibration(), within_m=5.0)
    assert found.gate.admits(make_refinement(residual_m=3.0))
    assert found.known == pytest.approx(2 / 3)
    assert found.known_right == 1


def test_refined_answer_has_the_gate_s_probability(calibration: Calibration) -> None:
    [answer] = answers_from_hits([hits(True, np.random.default_rng(2))], 10, calibration)
    assert (answer.within_m, answer.refinement) == (25.0, None)
    refinement = make_refinement(inliers=60)
    refined = with_refinement(answer, refinement, calibration)
    assert calibration.matching is not None
    gate = calibration.matching.gate
    assert refined.probability == gate.probability(refinement)
    assert (refined.within_m, refined.known) == (5.0, True)
    assert refined.position is not None
    assert refined.position.radius_m == pytest.approx(np.hypot(1.0, gate.floor_m))


def test_refined_answer_that_is_hardly_right_is_unknown(calibration: Calibration) -> None:
    """The gate lets it pass, and says itself that its position is wrong; a flight knows more."""
    assert calibration.matching is not None
    gate = calibration.matching.gate
    doubtful = replace(gate, model=replace(gate.model, intercept=-9.0))
    unsure = replace(calibration, matching=replace(calibration.matching, gate=doubtful))
    [answer] = answers_from_hits([hits(True, np.random.default_rng(2))], 10, calibration)
    refinement = make_refinement(inliers=60)
    refined = with_refinement(answer, refinement, unsure)
    assert refined.refinement is refinement
    assert refined.probability is not None
    assert refined.probability < LEAST_PROBABILITY
    assert not refined.known
    assert with_refinement(answer, refinement, unsure, of_flight=True).known


def test_tile_of_a_photo_that_no_match_holds_for(calibration: Calibration) -> None:
    """A tile that stands out stays known; one that does not becomes unknown."""
    rng = np.random.default_rng(3)
    near, far = answers_from_hits([hits(True, rng), hits(False, rng)], 10, calibration)
    chance = make_refinement(inliers=9)
    kept = with_refinement(near, chance, calibration)
    assert kept.known
    assert kept.position == near.position
    assert kept.refinement is None
    assert not with_refinement(far, None, calibration).known
    assert with_refinement(far, None, calibration, of_flight=True) == far
    assert with_refinement(far, None, make_calibration()) == far


def test_refined_answer_without_calibration_has_no_probability() -> None:
    [answer] = answers_from_hits([hits(True, np.random.default_rng(2))], 10)
    refined = with_refinement(answer, make_refinement(inliers=60))
    assert (refined.probability, refined.within_m, refined.known) == (None, None, True)
    assert with_refinement(answer, make_refinement(inliers=9)) == answer


def test_calibration_with_matching_is_read_again(calibration: Calibration, tmp_path: str) -> None:
    path = f"{tmp_path}/calibration.json"
    write_calibration(path, calibration)
    assert read_calibration(path, calibration.fingerprint) == calibration


def test_matching_without_right_refinements_is_refused() -> None:
    none = [replace(one, inside=None) for one in matched()]
    with pytest.raises(InputError, match="fewer than 10 of 60 photos are matched within 5 m"):
        fit_matching(none, make_calibration(), within_m=5.0)
