"""Chart descriptions and their layout: curves, gaps, ticks and histograms."""

import math

import numpy as np
import pytest

from pipeline.report.charts import nice_ticks, recall_chart, scores_chart, views_chart
from pipeline.report.svg import layout_chart
from pipeline.report.training_charts import training_charts
from tests.report.test_page import TOWN


def test_training_charts_cover_the_measures_in_the_rows() -> None:
    rows = [
        {"epoch": e, "location_loss": 9.0 / e, "alpha": 0.9 if e < 3 else 1.0} for e in range(1, 5)
    ]
    loss, alpha = training_charts(rows)
    assert (loss.title, alpha.title) == ("Location loss", "α")
    assert len(layout_chart(loss).curves[0].runs[0].split()) == 4
    assert len(loss.marks) == 1  # alpha grew once
    assert loss.summary == "Location loss over 4 epochs, from 9 to 2.25"


def test_layout_chart_leaves_a_gap_at_nan() -> None:
    rows = [{"epoch": e, "view_loss": math.nan if e == 3 else 1.0} for e in range(1, 6)]
    [chart] = training_charts(rows)
    assert [len(run.split()) for run in layout_chart(chart).curves[0].runs] == [2, 2]
    assert training_charts([{"epoch": 1, "view_loss": math.nan}]) == []


def test_training_charts_draw_one_epoch_as_a_dot() -> None:
    [chart] = training_charts([{"epoch": 1, "alpha": 0.9}])
    assert len(chart.series[0].dots) == 1
    drawn = layout_chart(chart)
    assert all(math.isfinite(tick.at) for tick in (*drawn.x_ticks, *drawn.y_ticks))


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [(0, 1, [0, 0.5, 1]), (0.9, 1.2, [0.9, 1.0, 1.1, 1.2]), (0, 41, [0, 20, 40, 60])],
)
def test_nice_ticks_are_round_and_enclose_the_range(
    low: float, high: float, ticks: list[float]
) -> None:
    assert nice_ticks(low, high) == ticks


@pytest.mark.parametrize("value", [0.0, 0.9, -3.0, 1e-12, 1e12])
def test_nice_ticks_enclose_a_constant(value: float) -> None:
    ticks = nice_ticks(value, value)
    assert ticks[0] < value < ticks[-1]


@pytest.mark.parametrize("gallery", [1, 2, 9, 951, 51_355])
def test_recall_chart_spans_the_gallery(gallery: int) -> None:
    chart = recall_chart("t", "", np.array([1, 2, 0]), gallery, np.array([0, 0, 1]), "other")
    assert [series.name for series in chart.series] == ["other", "this network"]
    assert chart.series[1].dots[0][2] == "R@1: 33.33 %"
    assert chart.x.ticks[0].label == "1"


def test_scores_chart_has_a_series_of_each_kind() -> None:
    chart = scores_chart("t", TOWN)
    assert chart
    assert chart.summary == "t: median score 0.870 of true matches, 0.890 of wrong answers"
    assert [series.role for series in chart.series] == ["beside", "main"]
    assert scores_chart("t", [TOWN[3]]) is None
    assert views_chart("t", []) is None
