"""Charts, each described once in data units: series, intervals, axes and labels.

In: metric rows, per-query rows and view gaps of an evaluation. Out: a `Chart` or a `Scatter`. `svg`
draws them for the page, `figure_charts` for papers.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from pipeline.core.arrays import Ints
from pipeline.report.inputs import EvaluationResults
from pipeline.retrieval.metrics import one_percent_k, recall_at

CURVE_POINTS = 160  # of a curve over thousands of K: more than the pixels can resolve
SCORE_BINS = 24

Row = Mapping[str, Any]
Point = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Tick:
    at: float
    label: str


@dataclass(frozen=True, kw_only=True)
class Axis:
    label: str
    "Without the unit. Only papers show it; the page has the chart's note."
    low: float
    high: float
    ticks: tuple[Tick, ...]
    log: bool = False
    percent: bool = False
    "The values are fractions, shown as percent."


@dataclass(frozen=True, kw_only=True)
class Series:
    """One curve."""

    name: str
    points: tuple[Point, ...]
    role: Literal["main", "beside"] = "main"
    "beside: drawn dashed, for comparison."
    dots: tuple[tuple[float, float, str], ...] = ()
    "x, y and text of the points that are drawn as dots."
    interval: tuple[tuple[float, float, float], ...] = ()
    "x, low and high of the 95 % interval; empty if there is none."
    bin_edges: tuple[float, ...] = ()
    "Edges of the bins whose middles the points are; empty if the series is no histogram."


@dataclass(frozen=True, kw_only=True)
class Chart:
    title: str
    note: str
    summary: str
    "The chart in words, for screen readers."
    series: tuple[Series, ...]
    x: Axis
    y: Axis
    marks: tuple[float, ...] = ()
    "x of the vertical hairlines."


@dataclass(frozen=True, kw_only=True)
class Scatter:
    """Embeddings of two views in two dimensions. Both axes have one scale, since distances in the
    embedding have."""

    title: str
    summary: str
    "The picture in words, for screen readers."
    query_view: str
    gallery_view: str
    query_points: tuple[Point, ...]
    gallery_points: tuple[Point, ...]
    pairs: tuple[tuple[Point, Point], ...]
    "The two images of a true pair, to be joined by a line."
    shares: tuple[float, float]
    "Share of the variance along either axis."
    statistics: tuple[tuple[str, str, str], ...]
    "Name, value and meaning."


def nice_ticks(low: float, high: float, most: int = 4) -> list[float]:
    """At most `most` + 1 round numbers, equally spaced, that enclose [low, high]."""
    if high <= low:
        pad = abs(low) * 0.1 or 1.0
        low, high = low - pad, high + pad
    for exponent in range(math.floor(math.log10((high - low) / most)), 400):
        for unit in (1, 2, 5):
            step = unit * 10.0**exponent
            first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
            if last - first <= most:
                return [float(f"{i * step:.12g}") for i in range(first, last + 1)]
    raise AssertionError("unreachable: some step spans the whole range")


def share_axis(label: str) -> Axis:
    """A y axis from 0 to 100 %."""
    ticks = tuple(Tick(at=y, label=f"{100 * y:g} %") for y in (0, 0.25, 0.5, 0.75, 1))
    return Axis(label=label, low=0, high=1, ticks=ticks, percent=True)


def recall_chart(
    title: str, note: str, first_Q: Ints, gallery: int, beside_Q: Ints | None, beside_name: str
) -> Chart:
    """Recall@K over K on a logarithmic axis, with dots at K = 1, 5, 10 and the top 1 %."""
    ks = sorted({min(gallery, round(k)) for k in np.geomspace(1, max(gallery, 1), CURVE_POINTS)})
    named = {k for k in (1, 5, 10, one_percent_k(gallery)) if k <= gallery}

    def curve(first: Ints, among: Iterable[int]) -> tuple[Point, ...]:
        return tuple((k, recall_at(k, first)) for k in among)

    dots = tuple((k, y, f"R@{k:.0f}: {100 * y:.2f} %") for k, y in curve(first_Q, sorted(named)))
    series = [Series(name="this network", points=curve(first_Q, ks), dots=dots)]
    if beside_Q is not None:
        series.insert(0, Series(name=beside_name, role="beside", points=curve(beside_Q, ks)))
    decades = [10**i for i in range(int(math.log10(gallery)) + 1)]
    ticks = tuple(Tick(at=k, label=f"{k:,}") for k in decades)
    return Chart(
        title=title,
        note=note,
        summary=f"{title}: " + ", ".join(text for _, _, text in dots),
        series=tuple(series),
        x=Axis(label="K", low=1, high=max(gallery, 2), ticks=ticks, log=True),
        y=share_axis("Recall@K"),
    )


def views_chart(title: str, rows: Sequence[Row]) -> Chart | None:
    """R@1 over the number of views per query, with its 95 % interval; None without rows."""
    if not rows:
        return None
    dots = tuple(
        (row["views"], row["r1"], f"{row['views']} views: {100 * row['r1']:.2f} %") for row in rows
    )
    curve = Series(
        name="R@1",
        points=tuple((x, y) for x, y, _ in dots),
        dots=dots,
        interval=tuple((row["views"], row["r1_low"], row["r1_high"]) for row in rows),
    )
    views = [row["views"] for row in rows]
    ticks = tuple(Tick(at=x, label=str(x)) for x in views)
    return Chart(
        title=title,
        note=f"from {rows[0]['queries']:,} queries of one view; dashed: 95 % intervals",
        summary=f"{title}: " + ", ".join(text for _, _, text in dots),
        series=(curve,),
        x=Axis(label="views per query, averaged", low=1, high=max(views), ticks=ticks, log=True),
        y=share_axis("R@1"),
    )


def scores_chart(title: str, rows: Sequence[Row]) -> Chart | None:
    """Shares of the queries by the score of their best true match and of their best wrong answer;
    None if either is missing everywhere.

    A wrong answer outside the top ten scores less than these, and is left out.
    """
    right, wrong = best_scores(rows)
    if not right or not wrong:
        return None
    x_ticks = nice_ticks(min(*right, *wrong), max(*right, *wrong))
    edges = np.linspace(x_ticks[0], x_ticks[-1], SCORE_BINS + 1)
    middles = ((edges[:-1] + edges[1:]) / 2).tolist()

    def histogram(name: str, role: Literal["main", "beside"], scores: Sequence[float]) -> Series:
        shares = (np.histogram(scores, edges)[0] / len(scores)).tolist()
        points = tuple(zip(middles, shares, strict=True))
        return Series(name=name, role=role, points=points, bin_edges=tuple(edges.tolist()))

    series = (
        histogram("best wrong answer", "beside", wrong),
        histogram("best right answer", "main", right),
    )
    y_ticks = nice_ticks(0, max(y for each in series for _, y in each.points))
    return Chart(
        title=title,
        note="queries by the score of their best true match; dashed: of their best wrong answer",
        summary=f"{title}: median score {np.median(right):.3f} of true matches, "
        f"{np.median(wrong):.3f} of wrong answers",
        series=series,
        x=Axis(
            label="cosine of the best answer",
            low=x_ticks[0],
            high=x_ticks[-1],
            ticks=tuple(Tick(at=x, label=f"{x:g}") for x in x_ticks),
        ),
        y=Axis(
            label="queries",
            low=0,
            high=y_ticks[-1],
            ticks=tuple(Tick(at=y, label=f"{100 * y:g} %") for y in y_ticks),
            percent=True,
        ),
    )


def best_scores(rows: Sequence[Row]) -> tuple[list[float], list[float]]:
    """Scores of the best true match and of the best wrong answer, each over the queries that have
    one."""
    right = [row["first_match_score"] for row in rows if row["first_match_score"] is not None]
    return right, [score for row in rows if (score := _best_wrong(row)) is not None]


def _best_wrong(row: Row) -> float | None:
    answers = zip(row["top_locations"], row["top_scores"], strict=True)
    return next((score for location, score in answers if location != row["location"]), None)


def scatter(gap: Row, beside: EvaluationResults | None = None) -> Scatter:
    """One row of view_gap.json. If another evaluation has the same task, its statistics are quoted
    beside."""
    query_view, gallery_view = gap["task"].split("->")
    statistics = _gap_statistics(gap)
    for other in beside.gaps if beside else ():
        if other["task"] == gap["task"] and beside:
            pairs = zip(statistics, _gap_statistics(other), strict=True)
            statistics = [
                (name, value, f"{meaning}; {beside.name}: {theirs[1]}")
                for (name, value, meaning), theirs in pairs
            ]
    at = [(point["x"], point["y"]) for point in gap["points"]]
    by_side: dict[str, list[Point]] = {"query": [], "gallery": []}
    for point, xy in zip(gap["points"], at, strict=True):
        by_side[point["side"]].append(xy)
    return Scatter(
        title=f"{query_view} and {gallery_view} images",
        summary=f"{len(by_side['query'])} {query_view} and {len(by_side['gallery'])} "
        f"{gallery_view} images in two dimensions: "
        + "; ".join(f"{name} {value}" for name, value, _ in statistics),
        query_view=query_view,
        gallery_view=gallery_view,
        query_points=tuple(by_side["query"]),
        gallery_points=tuple(by_side["gallery"]),
        pairs=tuple((at[i], at[j]) for i, j in gap["joined"]),
        shares=(gap["shares"][0], gap["shares"][1]),
        statistics=tuple(statistics),
    )


def _gap_statistics(gap: Row) -> list[tuple[str, str, str]]:
    true, other = gap["true"], gap["other"]
    both = " with ".join(gap["task"].split("->"))
    return [
        (
            "Cosine of true pairs",
            _cosine(true),
            f"{both} image of one place, {true['pairs']:,} pairs",
        ),
        (
            "of other pairs",
            _cosine(other),
            f"of different places, {other['pairs']:,}; in brackets 5 to 95 %",
        ),
        (
            "Distance of the views' means",
            f"{gap['distance']:.3f}",
            "in units of a view's spread; 0 where there is no gap",
        ),
        (
            "Variance shown",
            f"{100 * sum(gap['shares']):.0f} %",
            "by the two axes of the picture; the rest is not seen",
        ),
    ]


def _cosine(summary: Mapping[str, float]) -> str:
    return f"{summary['mean']:.3f} ({summary['low']:.2f} to {summary['high']:.2f})"
