"""Fitting a calibration on made-up galleries: right answers, the threshold, the agreement
radius."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.confidence.cross_validation import cross_validated_probabilities, youden_threshold
from pipeline.confidence.logistic import sigmoid
from pipeline.core.arrays import Floats
from pipeline.core.errors import InputError
from pipeline.core.filters import Filter
from pipeline.core.records import View
from pipeline.index.searcher import Hit
from pipeline.locate.calibration import Calibration
from pipeline.locate.fitting.calibrate import (
    CalibrationContext,
    CalibrationExample,
    choose_agreement_radius,
    fit_calibration,
    is_correct,
)
from pipeline.locate.fitting.calibration_data import LabelledImages, make_examples
from pipeline.locate.locate import answers_from_hits, consensus_of, consensus_scores
from pipeline.locate.settings import CalibrationCriteria
from pipeline.locate.track import TRACK_CANDIDATES

METRE = 1 / 111_195.08  # degrees of latitude
GALLERY = CalibrationContext(fingerprint="f" * 64, gallery_rows=40, spacing_m=300.0)


def hit(location: str, score: float, north_m: float | None = 0.0) -> Hit:
    lat, lon = (None, None) if north_m is None else (north_m * METRE, 8.0)
    return Hit(
        key=f"gallery-satellite-{location}",
        location=location,
        view=View.SATELLITE,
        lat=lat,
        lon=lon,
        score=score,
    )


def made(count: int, rng: np.random.Generator) -> list[CalibrationExample]:
    """Photos whose own location scores about 0.6, and 39 others about 0.35: right answers have high
    scores."""
    found = []
    for number in range(count):
        others = sorted(
            (hit(f"z{n}", float(rng.normal(0.35, 0.1)), 9000.0 * n) for n in range(1, 40)),
            key=lambda h: -h.score,
        )
        own = hit(f"p{number % 30}", float(rng.normal(0.6, 0.12)))
        inside = sorted([own, *others], key=lambda h: -h.score)
        found.append(
            CalibrationExample(
                location=own.location, lat=0.0, lon=8.0, inside=tuple(inside), outside=tuple(others)
            )
        )
    return found


@pytest.fixture(scope="module")
def fitted() -> Calibration:
    return fit_calibration(made(900, np.random.default_rng(0)), CalibrationCriteria(), GALLERY)


@pytest.mark.slow
def test_calibration_holds_for_unseen_photos(fitted: Calibration) -> None:
    fresh = made(900, np.random.default_rng(1))
    for low, high in ((0, 0.2), (0.2, 0.8), (0.8, 1)):
        inside = answers_from_hits([one.inside for one in fresh], 5, fitted)
        outside = answers_from_hits([one.outside for one in fresh], 5, fitted)
        pairs = [
            (a.probability or 0, a.location == one.location)
            for a, one in zip(inside, fresh, strict=True)
        ]
        pairs += [(a.probability or 0, False) for a in outside]
        here = [(p, right) for p, right in pairs if low <= p < high]
        assert np.mean([p for p, _ in here]) == pytest.approx(
            np.mean([right for _, right in here]), abs=0.05
        )


@pytest.mark.slow
def test_calibration_threshold_figures_hold_for_unseen_photos(
    fitted: Calibration,
) -> None:
    fresh = made(900, np.random.default_rng(2))
    outside = np.mean(
        [not one.known for one in answers_from_hits([one.outside for one in fresh], 5, fitted)]
    )
    right = [
        a.known
        for a, one in zip(
            answers_from_hits([e.inside for e in fresh], 5, fitted), fresh, strict=True
        )
        if a.location == one.location
    ]
    assert outside == pytest.approx(fitted.outside_unknown, abs=0.05)
    assert np.mean(right) == pytest.approx(fitted.right_kept, abs=0.05)
    assert outside > 0.8


@pytest.mark.slow
def test_calibration_smaller_outside_share_raises_probability(fitted: Calibration) -> None:
    data = made(900, np.random.default_rng(0))
    rare = fit_calibration(data, CalibrationCriteria(outside=0.1), GALLERY)
    agreed, scores_K = consensus_of(data[0].inside, 0), consensus_scores(data[0].inside)
    assert rare.probability(agreed, scores_K) > fitted.probability(agreed, scores_K)


def test_youden_threshold_by_hand() -> None:
    """At 0.6 two of three right answers are kept and no wrong one; at 0.3 all right ones and both
    wrong ones."""
    p, yes = np.array([0.9, 0.6, 0.5, 0.4, 0.3]), np.array([1.0, 1, 0, 0, 1])
    assert youden_threshold(p, yes, np.ones(5)) == 0.6


def test_is_correct_by_location_or_distance() -> None:
    example = CalibrationExample(
        location="own", lat=0.0, lon=8.0, inside=(hit("other", 0.9, 20),), outside=()
    )
    agreed = consensus_of(example.inside, 0)
    assert is_correct(agreed, example, 25)
    assert not is_correct(agreed, example, 15)
    named = CalibrationExample(
        location="own", lat=None, lon=None, inside=(hit("own", 0.9, None),), outside=()
    )
    assert is_correct(consensus_of(named.inside, 0), named, 25)


def test_agreement_radius_grows_only_if_significantly_better() -> None:
    """Overlapping tiles every 40 m: each photo lies between four, each of which is 28 m away. One
    photo is not significant."""
    d = 20 * METRE
    four = [(d, d), (d, -d), (-d, d), (-d, -d)]
    tiles = [
        Hit(
            key=f"k{n}",
            location=f"t{n}",
            view=View.SATELLITE,
            lat=lat,
            lon=lon,
            score=0.9 - n / 1000,
        )
        for n, (lat, lon) in enumerate(four)
    ]
    alone = Hit(key="k", location="far", view=View.SATELLITE, lat=1.0, lon=1.0, score=0.1)
    overlapping = [
        CalibrationExample(
            location=f"photo{n}", lat=0.0, lon=0.0, inside=(*tiles, alone), outside=()
        )
        for n in range(5)
    ]
    apart = CalibrationExample(
        location="a",
        lat=0.0,
        lon=8.0,
        inside=(hit("a", 0.9), hit("b", 0.8, 60), hit("c", 0.7, 50)),
        outside=(),
    )
    assert choose_agreement_radius(overlapping, 25, 40.0) == 1.5 * 40
    assert choose_agreement_radius(overlapping[:1], 25, 40.0) == 0.5 * 40
    assert choose_agreement_radius([apart] * 9, 25, 40.0) == 0.5 * 40
    assert choose_agreement_radius([apart], 25, None) == 0


def test_cross_validation_leaves_out_own_location() -> None:
    """One location's examples are labelled against the rule of all others; a model fitted with them
    would follow them."""
    rng = np.random.default_rng(0)
    x_NF = rng.normal(size=(200, 1))
    locations = np.array([f"place{n % 20}" for n in range(200)])
    odd = locations == "place7"
    yes = np.where(odd, x_NF[:, 0] < 0, x_NF[:, 0] > 0).astype(float)
    p = cross_validated_probabilities(x_NF, yes, np.ones(200), locations)
    assert ((p > 0.5) == (x_NF[:, 0] > 0))[odd].all()
    assert sigmoid(np.array([0.0]))[0] == 0.5
    alone = cross_validated_probabilities(x_NF[:2], yes[:2], np.ones(2), np.array(["a", "a"]))
    assert alone.tolist() == [0.5, 0.5]


def test_calibration_unusable_examples_are_refused() -> None:
    few = [one for one in made(60, np.random.default_rng(0)) if one.location in {"p1", "p2"}]
    with pytest.raises(InputError, match=r"4 photos of 2 locations.*--hold-out"):
        fit_calibration(few, CalibrationCriteria(), GALLERY)
    sure = [
        CalibrationExample(
            location=f"p{n}",
            lat=0.0,
            lon=8.0,
            inside=(hit(f"p{n}", 0.9), hit("z", 0.1, 9000)),
            outside=(hit("z", 0.1),),
        )
        for n in range(20)
    ]
    assert fit_calibration(sure, CalibrationCriteria(), GALLERY).accuracy == 1
    lost = [replace(one, location=f"x{n}", lat=-9.0) for n, one in enumerate(sure)]
    with pytest.raises(InputError, match="none of 20 photos is answered rightly"):
        fit_calibration(lost, CalibrationCriteria(), GALLERY)
    with pytest.raises(InputError, match="no gallery image lies beyond"):
        fit_calibration([replace(one, outside=()) for one in sure], CalibrationCriteria(), GALLERY)


@pytest.mark.parametrize(
    ("given", "sentence"),
    [({"tolerance": 0}, "--tolerance is 0"), ({"outside": 1}, "--outside is 1")],
)
def test_criteria_invalid_value_is_refused(given: dict[str, float], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        CalibrationCriteria(**given)


class Rows:
    """An index of rows at one location each, except for `own`, which has many; row n scores 1 - n /
    1000."""

    def __init__(self, own: int, others: int) -> None:
        names = ["own"] * own + [f"o{n}" for n in range(others)]
        self.hits = [
            replace(hit(name, 1 - n / 1000, 0.0 if name == "own" else 5000.0 * n), key=f"row {n}")
            for n, name in enumerate(names)
        ]
        self.dimension = 2

    def __len__(self) -> int:
        return len(self.hits)

    def search(
        self, queries_QD: Floats, k: int = 10, where: Filter | None = None
    ) -> list[list[Hit]]:
        return [self.hits[:k] for _ in queries_QD]


def labelled(location: str, vector: list[float], north_m: float = 0.0) -> LabelledImages:
    facts = {
        "key": f"train-{location}",
        "location": location,
        "view": "drone",
        "geotag": {"lat": north_m * METRE, "lon": 8.0},
    }
    return LabelledImages(records=[facts], embeddings_QD=np.array([vector], np.float32))


def test_examples_location_of_many_rows_is_left_out() -> None:
    (example,) = make_examples(
        labelled("own", [1, 0]), labelled("x", [0, 1]), Rows(100, 60), 300.0, 25.0
    )
    assert {one.location for one in example.inside} == {"own"}
    assert [one.location for one in example.outside] == [f"o{n}" for n in range(TRACK_CANDIDATES)]


def test_examples_rank_own_images_of_missing_location() -> None:
    """Its image scores 0.9975, between the third and the fourth row."""
    photos, own = labelled("new", [1, 0], -9000), labelled("new", [0.9975, 0], -9000)
    (example,) = make_examples(photos, own, Rows(0, 60), 300.0, 25.0)
    assert [one.location for one in example.inside][:4] == ["o0", "o1", "o2", "new"]
    assert "new" not in {one.location for one in example.outside}


def test_examples_leave_out_images_near_the_photo() -> None:
    (example,) = make_examples(
        labelled("photo", [1, 0], 5000), labelled("x", [0, 1]), Rows(0, 60), 300.0, 25.0
    )
    assert "o1" in {one.location for one in example.inside}
    assert "o1" not in {one.location for one in example.outside}


def test_examples_leave_out_coarse_images_further_away() -> None:
    """With a spacing of 300 m images up to 600 m are the photo's own; of three times the side, up
    to 1,800 m. Row o1 is 1,200 m off."""
    rows = Rows(0, 60)
    rows.hits = [replace(one, side_m=180.0 if one.location == "o1" else 60.0) for one in rows.hits]
    photo = labelled("photo", [1, 0], 6200)

    def others(finest_side_m: float | None) -> set[str]:
        (example,) = make_examples(photo, labelled("x", [0, 1]), rows, 300.0, 25.0, finest_side_m)
        return {one.location for one in example.outside}

    assert "o1" in others(None)
    assert "o1" not in others(60.0)
    assert "o2" in others(60.0)
