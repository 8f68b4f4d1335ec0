"""Answers of a flight whose photos were matched with the map: which refinements the track keeps."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.camera.pose import PartialPose
from pipeline.camera.uncertainty import covariance_of, ellipse_of
from pipeline.confidence.logistic import LogisticModel
from pipeline.core.records import View
from pipeline.index.searcher import Hit
from pipeline.locate.calibration import Calibration, MatchingCalibration
from pipeline.locate.flight import PhotoFacts, apply_track
from pipeline.locate.flight_places import camera_places, gaze_ahead_m, refined_place, tile_places
from pipeline.locate.locate import Answer, answers_from_hits
from pipeline.locate.odometry import Travelled
from pipeline.locate.track import Motion
from pipeline.matching.gate import GATE_FEATURES, Gate
from pipeline.matching.refine import Refinement
from tests.locate.calibrations import constant_model, make_calibration
from tests.matching.refinements import METRE_LAT, make_refinement

MOTION = Motion(max_speed=15, gallery_positions=400, spacing_m=50)


def gate_model(log_odds: float) -> LogisticModel:
    count = len(GATE_FEATURES)
    return LogisticModel(
        mean_F=(0.0,) * count, scale_F=(1.0,) * count, coefficient_F=(0.0,) * count,
        intercept=log_odds,
    )  # fmt: skip


GATE = Gate(
    place_model=gate_model(3.0), threshold=0.5, within_m=5.0, model=gate_model(2.0), floor_m=1.0
)
MATCHING = MatchingCalibration(
    gate=GATE, tile_model=constant_model(0.0), tile_threshold=0.5, photos=98, refined=0.9,
    known=0.9, known_right=0.9, outside_unknown=0.9, calibration_error=0.02, bins=(),
)  # fmt: skip
CALIBRATION: Calibration = replace(make_calibration(spacing_m=50.0), matching=MATCHING)


def answer(*norths_m: float) -> Answer:
    """By tiles so many metres north, the first the best; the last is far away and bad."""
    norths = [*norths_m, 90_000.0]
    hits = [
        Hit(
            key=f"t{north:g}", location=f"t{north:g}", view=View.SATELLITE, score=score,
            lat=46 + north * METRE_LAT, lon=8.0,
        )
        for north, score in zip(norths, np.linspace(0.5, 0.3, len(norths)).tolist(), strict=True)
    ]  # fmt: skip
    return answers_from_hits([hits], 30, CALIBRATION)[0]


def refined(north_m: float) -> PhotoFacts:
    return PhotoFacts(refinement=make_refinement(lat=46 + north_m * METRE_LAT))


def test_track_keeps_right_refinements_and_drops_a_wrong_one() -> None:
    """Three photos 100 m apart; the middle one is matched 5 km away, and its second tile lies
    between the others."""
    answers = [answer(10), answer(5000, 90), answer(190)]
    facts = [refined(0), refined(5000), refined(200)]
    found = apply_track(answers, [0, 10, 20], CALIBRATION, MOTION, facts=facts)
    hows = [one.position and one.position.how for one in found]
    assert hows == ["refined", "track", "refined"]
    assert [one.known for one in found] == [True, True, True]
    assert found[0].refinement == facts[0].refinement
    assert found[1].refinement is None
    assert (found[1].location, found[1].within_m) == ("t90", None)
    assert found[1].position is not None
    assert found[1].position.lat == pytest.approx(46 + 90 * METRE_LAT)


def test_refined_probability_is_that_of_a_near_position() -> None:
    """Alone: the place's odds are those of the gate, of a position within 5 m as the gate says."""
    [found] = apply_track([answer()], [0], CALIBRATION, MOTION, facts=[refined(0)])
    assert found.known
    assert found.within_m == 5.0
    assert found.probability == pytest.approx(1 / (1 + np.exp(-2)))
    [near] = apply_track([answer(10)], [0], CALIBRATION, MOTION, facts=[refined(0)])
    assert near.probability is not None
    assert found.probability is not None
    assert found.probability < near.probability <= 1  # its tile agrees
    assert (near.location, near.agreeing) == ("t10", 1)


def test_photo_that_the_track_skips_loses_its_refinement() -> None:
    answers = [answer(0), answer(5000), answer(200), answer(300)]
    facts = [refined(0), refined(5000), refined(200), refined(300)]
    found = apply_track(answers, [0, 10, 20, 30], CALIBRATION, MOTION, facts=facts)
    assert [one.known for one in found] == [True, False, True, True]
    assert found[1].refinement is None
    assert found[1].position == answers[1].position


def test_online_answers_change_only_with_earlier_photos() -> None:
    """The first photo is matched at the wrong place; later photos show it, in hindsight."""
    answers = [answer(0), answer(5100), answer(5200)]
    facts = [refined(0), refined(5100), refined(5200)]
    after = apply_track(answers, [0, 10, 20], CALIBRATION, MOTION, facts=facts)
    online = apply_track(answers, [0, 10, 20], CALIBRATION, MOTION, facts=facts, online=True)
    assert [one.known for one in after] == [False, True, True]
    assert online[0].known
    [first] = apply_track(answers[:1], [0], CALIBRATION, MOTION, facts=facts[:1], online=True)
    assert first == online[0]
    assert online[2].position == after[2].position
    assert online[2].probability == pytest.approx(after[2].probability)


def test_odometry_decides_between_refined_and_tile() -> None:
    """The camera flew 100 m north. A refinement 40 m to the south is within reach, not there."""
    answers = [answer(0), answer(100, 60)]
    sure = replace(refined(0), travelled=Travelled(chain=0))
    moved = Travelled(chain=0, north_m=100, variance_m2=4)
    second = refined(-40)
    for travelled, how in ((None, "refined"), (moved, "track")):
        facts = [sure, replace(second, travelled=travelled)]
        found = apply_track(answers, [0, 10], CALIBRATION, MOTION, facts=facts)[1]
        assert found.position is not None
        assert found.position.how == how
    assert found.location == "t100"


def test_place_probability_is_never_surer_than_its_photos() -> None:
    certain = replace(MATCHING, gate=replace(GATE, place_model=gate_model(40.0)))
    assert certain.place_probability(make_refinement()) == 0.99
    assert MATCHING.place_probability(make_refinement()) == pytest.approx(1 / (1 + np.exp(-3)))
    assert MATCHING.share_within(make_refinement()) == pytest.approx(
        (1 + np.exp(-3)) / (1 + np.exp(-2))
    )


def test_camera_of_a_tile_is_behind_its_ground() -> None:
    """It looks east, 45 degrees down from 100 m: it is 100 m to the west."""
    ground = tile_places(np.array([[46.0, 8.0]]), np.array([25.0]))
    pose = PartialPose(heading_deg=90.0, pitch_deg=-45.0, height_m=100.0)
    camera = camera_places(ground, pose)
    [[lat, lon]] = camera.positions_N2.tolist()
    assert lat == pytest.approx(46.0)
    assert (8.0 - lon) / METRE_LAT * np.cos(np.radians(46)) == pytest.approx(100, rel=0.01)
    assert camera.slack_N[0] > 25
    assert gaze_ahead_m(pose) == pytest.approx(100)
    assert np.isnan(camera_places(ground, PartialPose(pitch_deg=-45.0)).positions_N2).all()
    assert gaze_ahead_m(PartialPose(pitch_deg=-1.0, height_m=100.0)) == 0


def test_refined_place_has_its_ellipse_and_camera() -> None:
    found: Refinement = make_refinement(camera=(46.0, 8.0, 100.0))
    ground, camera = refined_place(found, GATE)
    ellipse = GATE.ellipse(found)
    assert ground.slack_N.tolist() == [ellipse.major_m]
    again = ellipse_of(ground.covariance_N22[0])
    assert (again.major_m, again.minor_m) == pytest.approx((ellipse.major_m, ellipse.minor_m))
    tilted = replace(ellipse, direction_deg=30.0)
    assert ellipse_of(covariance_of(tilted)).direction_deg == pytest.approx(30)
    extra = camera.covariance_N22[0] - ground.covariance_N22[0]
    assert extra == pytest.approx(6.0**2 * np.eye(2))
    assert np.isnan(refined_place(make_refinement(), GATE)[1].positions_N2).all()
