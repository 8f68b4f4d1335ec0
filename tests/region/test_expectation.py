"""What to expect: shares, intervals and groups by hand; pairs that look alike; the page."""

import io
import math
from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np
import pytest
from PIL import Image

from pipeline.camera.pose import PartialPose
from pipeline.core.arrays import Floats
from pipeline.core.filters import Filter
from pipeline.core.records import View
from pipeline.index.searcher import Hit
from pipeline.region import camera_ranges
from pipeline.region.camera_ranges import ranges_of_photos
from pipeline.region.expectation import (
    Outcome,
    coverage,
    expect,
    expectations,
    read_expectations,
    share_of,
)
from pipeline.region.lookalikes import find_lookalikes
from pipeline.region.page import RegionPage, render_region
from pipeline.simulation.over_map.settings import CameraRanges

METRE = 1 / 111_195.08  # degrees of latitude


def outcome(number: int, error_m: float, known: bool = True, posed: bool = True) -> Outcome:
    return Outcome(
        name=f"{number}.jpg", error_m=error_m, known=known, probability=0.9, within_m=5.0,
        refined=True, posed=posed, height_m=60.0 + number, pitch_deg=-90.0 + number,
    )  # fmt: skip


def test_share_and_its_interval_by_hand() -> None:
    """Wilson's interval of 8 of 10 is 49.0 to 94.3 %."""
    share = share_of([True] * 8 + [False] * 2)
    assert (share.value, share.count) == (0.8, 10)
    assert share.low == pytest.approx(0.490, abs=1e-3)
    assert share.high == pytest.approx(0.943, abs=1e-3)
    assert (share_of([]).low, share_of([]).high) == (0, 1)
    assert math.isnan(share_of([]).value)


def test_expectation_counts_unknown_photos_as_not_found() -> None:
    given = [outcome(0, 0.5), outcome(1, 4.0), outcome(2, 30.0), outcome(3, 0.1, known=False)]
    found = expect("all", given)
    assert [share.value for share in found.within] == [0.25, 0.5, 0.5]
    assert found.answered.value == 0.75
    assert found.wrong.value == pytest.approx(1 / 3)
    assert (found.median_m, found.p90_m) == (4.0, 30.0)
    assert found.calibration_gap == pytest.approx(0.9 - 2 / 3)
    nothing = expect("none", [outcome(0, math.inf, known=False)])
    assert math.isnan(nothing.median_m)
    assert nothing.within[2].value == 0


def test_coverage_at_a_precision_by_hand() -> None:
    """Surest first: right, right, wrong, right, right, and one that is unknown."""
    sure = zip((0.99, 0.9, 0.8, 0.7, 0.6, 0.5), (1.0, 2.0, 30.0, 3.0, 4.0, 1.0), strict=True)
    given = [
        replace(outcome(number, error_m, known=number < 5), probability=probability)
        for number, (probability, error_m) in enumerate(sure)
    ]
    assert coverage(given, 1.0, 5.0) == pytest.approx(2 / 6)
    assert coverage(given, 0.75, 5.0) == pytest.approx(5 / 6)
    assert coverage(given, 0.75, 1.5) == pytest.approx(1 / 6)
    assert coverage(given, 0.9, 0.5) == 0
    tied = [replace(one, probability=0.9) for one in given[:3]]
    assert coverage(tied, 0.9, 5.0) == 0  # two right ones cannot be told from the wrong one
    assert coverage([], 0.9, 5.0) == 0


def test_expectations_by_way_height_and_pitch() -> None:
    given = [outcome(n, n) for n in range(9)] + [outcome(n, n, posed=False) for n in range(9)]
    titles = [(one.title, one.photos) for one in expectations(given)]
    assert read_expectations([asdict(one) for one in expectations(given)]) == expectations(given)
    assert titles == [
        ("with the camera's tags", 9), ("without them", 9),
        ("60 to 62 m high", 6), ("63 to 65 m high", 6), ("66 to 68 m high", 6),
        ("pitch -90 to -88 degrees", 6), ("pitch -87 to -85 degrees", 6),
        ("pitch -84 to -82 degrees", 6),
    ]  # fmt: skip


class Rows:
    """An index of a few rows, 100 m from each other to the north."""

    dimension = 3

    def __init__(self, embeddings_ND: Floats) -> None:
        self.embeddings_ND = embeddings_ND

    def __len__(self) -> int:
        return len(self.embeddings_ND)

    def search(
        self, queries_QD: Floats, k: int = 10, where: Filter | None = None
    ) -> list[list[Hit]]:
        answers = []
        for scores_N in queries_QD @ self.embeddings_ND.T:
            order = np.argsort(-scores_N)[:k].tolist()
            answers.append(
                [
                    Hit(key=f"k{n}", location=f"k{n}", view=View.SATELLITE, lat=n * 100 * METRE,
                        lon=8.0, score=float(scores_N[n]))
                    for n in order
                ]
            )  # fmt: skip
        return answers


def test_lookalikes_are_far_apart_and_alike() -> None:
    """Rows 0 and 1 are alike and neighbours, 0 and 4 are nearly as alike and far apart."""
    rows_ND = np.array([[1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.9, 0.1, 0]], np.float32)
    positions_N2 = np.array([[n * 100 * METRE, 8.0] for n in range(5)])
    [pair] = find_lookalikes(Rows(rows_ND), [f"k{n}" for n in range(5)], positions_N2, rows_ND,
                             apart_m=250, count=1)  # fmt: skip
    assert pair.keys == ("k0", "k4")
    assert pair.apart_m == pytest.approx(400, rel=0.01)
    assert pair.score == pytest.approx(0.9)


def test_ranges_of_photos_leave_out_what_tags_do_not_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    poses = {
        "a": PartialPose(height_m=50.0, pitch_deg=-90.0),
        "b": PartialPose(height_m=70.0, pitch_deg=-10.0),
        "c": None,
    }
    monkeypatch.setattr(camera_ranges, "_pose", lambda path: poses[path])
    otherwise = CameraRanges(height=(1, 2), pitch=(-60, -50), fov=(40, 60))
    found = ranges_of_photos(["a", "b", "c"], otherwise)
    assert np.allclose(found.height, (51, 69))
    assert found.pitch == (-90.0, -90.0)
    assert found.fov_range == (40, 60)


def photo() -> bytes:
    stream = io.BytesIO()
    Image.new("RGB", (8, 8), (90, 120, 60)).save(stream, "PNG")
    return stream.getvalue()


def test_page_shows_figures_examples_and_lookalikes() -> None:
    outcomes = [outcome(0, 0.5), outcome(1, 60.0), outcome(2, math.inf, known=False)]
    rows_ND = np.eye(3, dtype=np.float32)
    lookalikes = find_lookalikes(
        Rows(rows_ND), ["k0"], np.array([[0.0, 8.0]]), rows_ND[:1], apart_m=50, count=3
    )
    page = RegionPage(
        name="<map>.tif", flat=True, expectations=expectations(outcomes), real=None,
        outcomes=outcomes, lookalikes=lookalikes, seconds={"1 tiles": 60.0},
        commands=["pvda locate --index region/index"],
    )  # fmt: skip

    def load(keys: Sequence[str]) -> dict[str, bytes]:
        return dict.fromkeys(keys, photo())

    html = render_region(page, lambda keys: load(list(keys)), lambda keys: load(list(keys)))
    assert "<map>" not in html
    for text in ("33.3 %", "Found within 5 m", "more than 25 m off", "Unknown:", "m apart",
                 "pvda locate --index region/index", "taken for flat"):  # fmt: skip
        assert text in html
    assert html.count("data:image/webp") == 3 + 2
