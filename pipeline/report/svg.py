"""Curves as SVG geometry: series of numbers in, coordinates, ticks and labels out; the template
draws them.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from pipeline.core.arrays import Ints
from pipeline.retrieval.metrics import one_percent_k, recall_at

WIDTH, HEIGHT = 340, 190
LEFT, RIGHT, TOP, BOTTOM = 40, 12, 12, 26
CURVE_POINTS = 160  # of a curve over thousands of K: more than the pixels can tell apart

TRAINING_CHARTS = {
    "location_loss": ("Location loss", "cross-entropy summed over parts and views (eq. 1)"),
    "view_loss": ("View loss", "the discriminator's (eq. 2)"),
    "adversarial_loss": ("Adversarial loss", "the encoder's, labels swapped (eq. 3)"),
    "discriminator_accuracy": ("Discriminator accuracy", "views told apart, share of images"),
    "alpha": ("α", "weight of the adversarial loss (eq. 4)"),
    "learning_rate_scale": ("Learning rate", "share of its initial value"),
}
FROM_ZERO = {"location_loss", "view_loss", "adversarial_loss", "learning_rate_scale"}

Point = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Tick:
    at: float
    label: str


@dataclass(frozen=True, kw_only=True)
class Line:
    """One curve; `runs` are its unbroken stretches, as SVG point lists."""

    name: str
    style: str
    "Class of the template's style sheet: main or beside."
    runs: tuple[str, ...]
    dots: tuple[tuple[float, float, str], ...] = ()
    "x, y and what to say of the points that are drawn as dots."


@dataclass(frozen=True, kw_only=True)
class Chart:
    title: str
    note: str
    summary: str
    "The curve in words, for those who cannot see it."
    lines: tuple[Line, ...]
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    marks: tuple[float, ...] = ()
    "x of the vertical hairlines."


def nice_ticks(low: float, high: float, most: int = 4) -> list[float]:
    """At most `most` + 1 round numbers that enclose [low, high]."""
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


def training_charts(rows: Sequence[Mapping[str, Any]]) -> list[Chart]:
    """One small chart for each measure that the rows hold; a hairline where alpha grows."""
    grown = [now["epoch"] for was, now in pairwise(rows) if now.get("alpha") != was.get("alpha")]
    charts = []
    for name, (title, note) in TRAINING_CHARTS.items():
        points = [
            (float(row["epoch"]), float(row[name])) for row in rows if row.get(name) is not None
        ]
        shown = [y for _, y in points if math.isfinite(y)]
        if not shown:
            continue
        y_ticks = nice_ticks(min([0.0, *shown] if name in FROM_ZERO else shown), max(shown))
        x_ticks = [
            x for x in nice_ticks(points[0][0], points[-1][0]) if points[0][0] <= x <= points[-1][0]
        ]
        frame = Frame(points[0][0], points[-1][0], y_ticks[0], y_ticks[-1])
        dots = [points[0]] if len(points) == 1 else []
        charts.append(
            Chart(
                title=title,
                note=note,
                summary=f"{title} over {len(points)} epochs, from {shown[0]:.3g} to {shown[-1]:.3g}",
                lines=(
                    frame.line(
                        name, "main", points, [(x, y, f"epoch {x:g}: {y:.4g}") for x, y in dots]
                    ),
                ),
                x_ticks=tuple(
                    Tick(at=frame.x(x), label=f"{x:g}") for x in x_ticks or [points[0][0]]
                ),
                y_ticks=tuple(Tick(at=frame.y(y), label=f"{y:g}") for y in y_ticks),
                marks=tuple(frame.x(x) for x in grown),
            )
        )
    return charts


def recall_chart(
    title: str, note: str, first_Q: Ints, gallery: int, beside_Q: Ints | None, beside_name: str
) -> Chart:
    """Recall@K over K on a logarithmic axis, with dots at K = 1, 5, 10 and the top 1 %."""
    frame = Frame(0, max(math.log10(gallery), 0.3), 0, 1)
    ks = sorted({min(gallery, round(k)) for k in np.geomspace(1, max(gallery, 1), CURVE_POINTS)})
    named = {k for k in (1, 5, 10, one_percent_k(gallery)) if k <= gallery}

    def points(first: Ints, among: Iterable[int]) -> list[Point]:
        return [(math.log10(k), recall_at(k, first)) for k in among]

    dots = [(x, y, f"R@{10**x:.0f}: {100 * y:.2f} %") for x, y in points(first_Q, sorted(named))]
    lines = [frame.line("this network", "main", points(first_Q, ks), dots)]
    if beside_Q is not None:
        lines.insert(0, frame.line(beside_name, "beside", points(beside_Q, ks)))
    decades = [10**i for i in range(int(math.log10(gallery)) + 1)]
    return Chart(
        title=title, note=note,
        summary=f"{title}: " + ", ".join(text for _, _, text in dots),
        lines=tuple(lines),
        x_ticks=tuple(Tick(at=frame.x(math.log10(k)), label=f"{k:,}") for k in decades),
        y_ticks=tuple(Tick(at=frame.y(y), label=f"{100 * y:g} %") for y in (0, 0.25, 0.5, 0.75, 1)),
    )  # fmt: skip


@dataclass(frozen=True)
class Frame:
    """From numbers to the chart's coordinates."""

    x_low: float
    x_high: float
    y_low: float
    y_high: float

    def x(self, value: float) -> float:
        share = (
            (value - self.x_low) / (self.x_high - self.x_low) if self.x_high > self.x_low else 0.5
        )
        return round(LEFT + share * (WIDTH - LEFT - RIGHT), 1)

    def y(self, value: float) -> float:
        return round(
            HEIGHT
            - BOTTOM
            - (value - self.y_low) / (self.y_high - self.y_low) * (HEIGHT - TOP - BOTTOM),
            1,
        )

    def line(
        self,
        name: str,
        style: str,
        points: Sequence[Point],
        dots: Sequence[tuple[float, float, str]] = (),
    ) -> Line:
        runs: list[list[str]] = [[]]
        for x, y in points:
            if math.isfinite(y):
                runs[-1].append(f"{self.x(x)},{self.y(y)}")
            elif runs[-1]:
                runs.append([])  # a loss that is not a number leaves a gap, not a made-up point
        drawn = tuple((self.x(x), self.y(y), text) for x, y, text in dots)
        return Line(
            name=name, style=style, runs=tuple(" ".join(run) for run in runs if run), dots=drawn
        )
