"""From candidates to answers: positions, radii, unknown answers, calibrations and flights."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipeline.confidence.logistic import LogisticModel
from pipeline.core.arrays import Floats
from pipeline.core.errors import InputError
from pipeline.core.filters import Filter
from pipeline.core.records import View
from pipeline.index.searcher import Hit
from pipeline.locate.calibration import (
    Calibration,
    confidence_features,
    find_calibration,
    read_calibration,
    write_calibration,
)
from pipeline.locate.flight import apply_track
from pipeline.locate.locate import (
    CONSENSUS_CANDIDATES,
    NO_ANSWER,
    answers_from_hits,
    consensus_of,
    consensus_scores,
    locate_embeddings,
    relative_scores,
    search_views,
)
from pipeline.locate.track import Motion
from tests.locate.calibrations import make_calibration

METRE = 1 / 111_195.08  # degrees of latitude


def hit(location: str, score: float, north_m: float | None = 0.0) -> Hit:
    lat, lon = (None, None) if north_m is None else (46 + north_m * METRE, 8.0)
    return Hit(
        key=f"gallery-satellite-{location}",
        location=location,
        view=View.SATELLITE,
        lat=lat,
        lon=lon,
        score=score,
    )


def calibration(**changes: Any) -> Calibration:
    """The probability depends on the margin alone: 0.5 at a margin of 0.1."""
    model = LogisticModel(
        mean_F=(0, 0.1, 0, 0), scale_F=(1, 0.05, 1, 1), coefficient_F=(0, 2.0, 0, 0), intercept=0.0
    )
    return make_calibration(**{"model": model} | changes)


class Gallery:
    """An index that returns given hits and records the number of candidates requested."""

    def __init__(self, hits: list[Hit]) -> None:
        self.hits, self.requested_k = hits, [0]
        self.dimension = 4

    def __len__(self) -> int:
        return len(self.hits)

    def search(
        self, queries_QD: Floats, k: int = 10, where: Filter | None = None
    ) -> list[list[Hit]]:
        self.requested_k.append(k)
        return [self.hits[:k] for _ in queries_QD]


HITS = [hit("a", 0.9), hit("b", 0.7, 1000), hit("c", 0.5, 2000)]


def test_answer_position_and_radius_without_calibration() -> None:
    (found,) = answers_from_hits([HITS], 2, spacing_m=300)
    assert found.position is not None
    assert (found.location, found.position.lat, found.position.radius_m) == ("a", 46, 150)
    assert [one.location for one in found.candidates] == ["a", "b"]
    assert (found.probability, found.known) == (None, True)


def test_answer_known_above_threshold_only() -> None:
    """Margins 0.2 and 0.05: sigmoid(2 * 2) and sigmoid(2 * -1)."""
    doubtful = [hit("a", 0.75), hit("b", 0.7, 1000), hit("c", 0.5, 2000)]
    sure, other = answers_from_hits([HITS, doubtful], 5, calibration())
    assert sure.probability == pytest.approx(1 / (1 + np.exp(-4)))
    assert other.probability == pytest.approx(1 / (1 + np.exp(2)))
    assert (sure.known, other.known) == (True, False)


def test_confidence_features_by_hand() -> None:
    assert confidence_features(consensus_of(HITS, 0), consensus_scores(HITS)) == pytest.approx(
        [0.9, 0.2, 0.2, 1 / 3]
    )


def test_answers_without_hits_are_no_answer() -> None:
    found = answers_from_hits([[], HITS, []], 5, calibration())
    assert found[0] == found[2] == NO_ANSWER
    assert found[1].location == "a"


def test_answer_of_candidates_without_positions() -> None:
    (found,) = answers_from_hits([[hit("a", 0.9, None), hit("b", 0.2, None)]], 5)
    assert (found.location, found.position, found.known) == ("a", None, True)


def test_answer_does_not_depend_on_candidates_listed() -> None:
    gallery = Gallery(
        [hit(f"{number:02d}", 0.9 - number / 100, 500 * number) for number in range(20)]
    )
    few, many = (
        locate_embeddings(gallery, np.ones((1, 4), np.float32), k, None, calibration())[0]
        for k in (1, 15)
    )
    assert gallery.requested_k[1:] == [CONSENSUS_CANDIDATES, 15]
    assert (len(few.candidates), len(many.candidates)) == (1, 15)
    assert few.probability == many.probability


def test_relative_scores_by_hand() -> None:
    hits = [hit("a", 1 - number / 100) for number in range(12)]
    assert relative_scores(hits)[[0, CONSENSUS_CANDIDATES - 1]] == pytest.approx([0.09, 0])
    assert relative_scores([]).shape == (0,)


def test_calibration_round_trip(tmp_path: Any) -> None:
    write_calibration(str(tmp_path / "calibration.json"), calibration())
    assert find_calibration(str(tmp_path), "f" * 64) == calibration()
    assert find_calibration(str(tmp_path / "elsewhere"), "f" * 64) is None


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("{", "is not a calibration"),
        ("[]", "is not a calibration"),
        ('{"schema_version": 1}', "is not a calibration"),
    ],
)
def test_calibration_invalid_file_is_refused(tmp_path: Any, text: str, sentence: str) -> None:
    (tmp_path / "calibration.json").write_text(text)
    with pytest.raises(InputError, match=sentence):
        read_calibration(str(tmp_path / "calibration.json"), "f" * 64)


def test_calibration_of_another_encoder_is_refused(tmp_path: Any) -> None:
    write_calibration(str(tmp_path / "calibration.json"), calibration())
    with pytest.raises(InputError, match="encoder ffffffffffff and the index with 000"):
        read_calibration(str(tmp_path / "calibration.json"), "0" * 64)


def test_search_views_prefers_the_level_of_each_photo() -> None:
    fine = replace(hit("fine", 0.60), side_m=60.0)
    coarse = replace(hit("coarse", 0.61), side_m=240.0)
    unknown = hit("unknown", 0.605)
    views = [np.ones((count, 4), np.float32) for count in (1, 3, 2)]
    gallery = Gallery([coarse, unknown, fine])
    found = search_views(gallery, views, 5, None, [(0.0, 120.0), None, (120.0, math.inf)])
    assert [[one.location for one in hits] for hits in found] == [
        ["fine", "coarse", "unknown"], ["coarse", "unknown", "fine"], ["coarse", "unknown", "fine"],
    ]  # fmt: skip
    assert [hits[0].score for hits in found] == pytest.approx([0.62, 0.61, 0.63])
    assert search_views(gallery, [], 5) == []


def test_answer_radius_grows_with_the_level() -> None:
    coarse = [replace(one, side_m=240.0) for one in HITS]
    (found,) = answers_from_hits([coarse], 2, spacing_m=30, finest_side_m=60)
    (flat,) = answers_from_hits([HITS], 2, spacing_m=30)
    assert found.position is not None
    assert flat.position is not None
    assert found.position.radius_m >= 4 * 15
    assert flat.position.radius_m < found.position.radius_m


def test_apply_track_decides_uncertain_photo_in_any_order() -> None:
    """In the middle of three photos 10 s apart, b, 9 km away, scores best; 25 m/s leave c, near the
    others."""
    middle = [hit("b", 0.8, 9000), hit("c", 0.75, 200), hit("z", 0.2, 50_000)]
    first, last = (
        [hit(name, 0.9, north), hit("z", 0.3, 50_000)] for name, north in (("a", 0), ("d", 400))
    )
    single = answers_from_hits([last, middle, first], 5, calibration(spacing_m=None))
    found = apply_track(single, [20, 10, 0], calibration(spacing_m=None), Motion(max_speed=25))
    assert [one.location for one in single] == ["d", "b", "a"]
    assert [one.location for one in found] == ["d", "c", "a"]
    assert found[1].position is not None
    assert found[1].position.lat == pytest.approx(46 + 200 * METRE)
    assert found[1].known


def test_apply_track_share_elsewhere_lowers_probability() -> None:
    doubtful = [hit("a", 0.5), hit("z", 0.45, 50_000)]
    single = answers_from_hits([doubtful], 5, calibration())
    rare, common = (
        apply_track(single, [0], calibration(), Motion(elsewhere=share))[0] for share in (0.01, 0.9)
    )
    assert (rare.known, common.known) == (True, False)


def test_apply_track_skipped_photo_is_unknown() -> None:
    far = [hit("b", 0.9, 9000), hit("z", 0.2, 50_000)]
    near = [
        [hit(name, 0.9, north), hit("z", 0.2, 50_000)]
        for name, north in (("a", 0), ("c", 50), ("d", 100))
    ]
    single = answers_from_hits([near[0], far, *near[1:]], 5, calibration())
    found = apply_track(
        single, [0, 10, 20, 30], replace(calibration(), none_log_odds=0.0), Motion(max_speed=25)
    )
    assert [one.known for one in found] == [True, False, True, True]
    assert found[1].location == "b"
    assert found[1].probability is not None
    assert found[1].probability < 0.05
