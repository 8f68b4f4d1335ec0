"""Charts of a training run: rows of its metrics.jsonl in, one chart per measure out."""

import math
from collections.abc import Sequence
from itertools import pairwise

from pipeline.report.charts import Axis, Chart, Row, Series, Tick, nice_ticks

TRAINING_CHARTS = {
    "location_loss": ("Location loss", "cross-entropy summed over parts and views (eq. 1)"),
    "view_loss": ("View loss", "the discriminator's (eq. 2)"),
    "adversarial_loss": ("Adversarial loss", "the encoder's, labels swapped (eq. 3)"),
    "discriminator_accuracy": ("Discriminator accuracy", "views told apart, share of images"),
    "alpha": ("α", "weight of the adversarial loss (eq. 4)"),
    "learning_rate_scale": ("Learning rate", "share of its initial value"),
}
FROM_ZERO = {"location_loss", "view_loss", "adversarial_loss", "learning_rate_scale"}


def training_charts(rows: Sequence[Row]) -> list[Chart]:
    """One small chart for each measure in the rows; hairlines at the epochs where alpha grows."""
    grown = [now["epoch"] for was, now in pairwise(rows) if now.get("alpha") != was.get("alpha")]
    charts = []
    for name, (title, note) in TRAINING_CHARTS.items():
        points = [
            (float(row["epoch"]), float(row[name])) for row in rows if row.get(name) is not None
        ]
        finite = [y for _, y in points if math.isfinite(y)]
        if not finite:
            continue
        first, last = points[0][0], points[-1][0]
        x_ticks = [x for x in nice_ticks(first, last) if first <= x <= last] or [first]
        y_ticks = nice_ticks(min([0.0, *finite] if name in FROM_ZERO else finite), max(finite))
        dots = tuple((x, y, f"epoch {x:g}: {y:.4g}") for x, y in points if len(points) == 1)
        charts.append(
            Chart(
                title=title,
                note=note,
                summary=f"{title} over {len(points)} epochs, "
                f"from {finite[0]:.3g} to {finite[-1]:.3g}",
                series=(Series(name=name, points=tuple(points), dots=dots),),
                x=_linear_axis("epoch", first, last, x_ticks),
                y=_linear_axis(title, y_ticks[0], y_ticks[-1], y_ticks),
                marks=tuple(grown),
            )
        )
    return charts


def _linear_axis(label: str, low: float, high: float, ticks: Sequence[float]) -> Axis:
    marked = tuple(Tick(at=at, label=f"{at:g}") for at in ticks)
    return Axis(label=label, low=low, high=high, ticks=marked)
