"""Charts as SVG geometry: descriptions of `charts` in, coordinates, point lists and labels out.

The page's templates draw the result; `report_macros.html` has the elements.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.report.charts import Axis, Chart, Point, Scatter, Series, Tick

CHART_WIDTH, CHART_HEIGHT = 340, 190
LEFT, RIGHT, TOP, BOTTOM = 40, 12, 12, 26
"Margins of a chart, which hold the labels."
SCATTER_WIDTH, SCATTER_HEIGHT, SCATTER_MARGIN = 400, 320, 14


@dataclass(frozen=True, kw_only=True)
class SvgCurve:
    """One curve; `runs` are its unbroken stretches, as SVG point lists."""

    name: str
    css_class: str
    runs: tuple[str, ...]
    dots: tuple[tuple[float, float, str], ...] = ()
    "x, y and text of the points that are drawn as dots."


@dataclass(frozen=True, kw_only=True)
class SvgChart:
    title: str
    note: str
    summary: str
    curves: tuple[SvgCurve, ...]
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    marks: tuple[float, ...]
    "x of the vertical hairlines."


@dataclass(frozen=True, kw_only=True)
class SvgScatter:
    """A scatter as three SVG paths."""

    scatter: Scatter
    discs: str
    "The queries' view: strokes of no length, which round caps make discs."
    triangles: str
    "The gallery's view."
    joins: str
    "Thin lines between the two images of a true pair."


@dataclass(frozen=True)
class ChartFrame:
    """Maps data to the chart's coordinates."""

    x_axis: Axis
    y_axis: Axis

    def x(self, value: float) -> float:
        share = _share(self.x_axis, value)
        return round(LEFT + share * (CHART_WIDTH - LEFT - RIGHT), 1)

    def y(self, value: float) -> float:
        share = _share(self.y_axis, value)
        return round(CHART_HEIGHT - BOTTOM - share * (CHART_HEIGHT - TOP - BOTTOM), 1)

    def curve(
        self,
        name: str,
        css_class: str,
        points: Sequence[Point],
        dots: Sequence[tuple[float, float, str]] = (),
    ) -> SvgCurve:
        runs: list[list[str]] = [[]]
        for x, y in points:
            if math.isfinite(y):
                runs[-1].append(f"{self.x(x)},{self.y(y)}")
            elif runs[-1]:
                runs.append([])  # a loss that is NaN leaves a gap, not an invented point
        return SvgCurve(
            name=name,
            css_class=css_class,
            runs=tuple(" ".join(run) for run in runs if run),
            dots=tuple((self.x(x), self.y(y), text) for x, y, text in dots),
        )


def layout_chart(chart: Chart) -> SvgChart:
    """Lay out a chart. An interval becomes two dashed curves below its own."""
    frame = ChartFrame(chart.x, chart.y)
    return SvgChart(
        title=chart.title,
        note=chart.note,
        summary=chart.summary,
        curves=tuple(curve for series in chart.series for curve in _curves(frame, series)),
        x_ticks=tuple(Tick(at=frame.x(tick.at), label=tick.label) for tick in chart.x.ticks),
        y_ticks=tuple(Tick(at=frame.y(tick.at), label=tick.label) for tick in chart.y.ticks),
        marks=tuple(frame.x(x) for x in chart.marks),
    )


def layout_scatter(scatter: Scatter) -> SvgScatter:
    """Lay out a scatter: one scale for both axes, as large as fits the frame."""
    points = (*scatter.query_points, *scatter.gallery_points)
    at_S2 = np.array([(x, -y) for x, y in points])  # SVG's y grows downwards
    low, high = at_S2.min(0), at_S2.max(0)
    size = np.array([SCATTER_WIDTH, SCATTER_HEIGHT])
    scale = float(((size - 2 * SCATTER_MARGIN) / np.maximum(high - low, 1e-9)).min())

    def place(x: float, y: float) -> Point:
        at = size / 2 + (np.array([x, -y]) - (low + high) / 2) * scale
        return round(float(at[0]), 1), round(float(at[1]), 1)

    queries = [place(*point) for point in scatter.query_points]
    gallery = [place(*point) for point in scatter.gallery_points]
    pairs = [(place(*one), place(*other)) for one, other in scatter.pairs]
    return SvgScatter(
        scatter=scatter,
        discs="".join(f"M{x} {y}h0" for x, y in queries),
        triangles="".join(f"M{x} {y - 4.2:.1f}l4.2 7h-8.4z" for x, y in gallery),
        joins="".join(f"M{x1} {y1}L{x2} {y2}" for (x1, y1), (x2, y2) in pairs),
    )


def _curves(frame: ChartFrame, series: Series) -> Iterator[SvgCurve]:
    if series.interval:
        for end, name in ((1, "low"), (2, "high")):
            points = [(bounds[0], bounds[end]) for bounds in series.interval]
            yield frame.curve(f"95 % interval, {name}", "beside", points)
    yield frame.curve(series.name, series.role, series.points, series.dots)


def _share(axis: Axis, value: float) -> float:
    """How far along the axis a value lies, from 0 to 1; the middle if the axis has no length."""
    low, high = axis.low, axis.high
    if axis.log:
        low, high, value = math.log10(low), math.log10(high), math.log10(value)
    return (value - low) / (high - low) if high > low else 0.5
