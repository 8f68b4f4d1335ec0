"""Charts that say how far to trust the measures: by number of views, and how scores of right and wrong answers part."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.report_charts import Chart, Frame, Tick, nice_ticks

BINS = 24


def views_chart(title: str, rows: Sequence[Mapping[str, Any]]) -> Chart | None:
    """R@1 over the number of views a query is the mean of, with the bounds of its 95 % intervals; None without rows."""
    if not rows:
        return None
    at = {row["views"]: np.log2(row["views"]) for row in rows}
    frame = Frame(0, max(at.values()), 0, 1)
    dots = [(at[row["views"]], row["r1"], f"{row['views']} views: {100 * row['r1']:.2f} %") for row in rows]
    lines = [
        frame.line(f"95 % interval, {end}", "beside", [(at[row["views"]], row[f"r1_{end}"]) for row in rows])
        for end in ("low", "high")
    ]
    lines.append(frame.line("R@1", "main", [(x, y) for x, y, _ in dots], dots))
    return Chart(
        title=title, note=f"from {rows[0]['queries']:,} queries of one view; dashed: 95 % intervals",
        summary=f"{title}: " + ", ".join(text for _, _, text in dots),
        lines=tuple(lines),
        x_ticks=tuple(Tick(at=frame.x(x), label=str(views)) for views, x in at.items()),
        y_ticks=tuple(Tick(at=frame.y(y), label=f"{100 * y:g} %") for y in (0, 0.25, 0.5, 0.75, 1)),
    )  # fmt: skip


def scores_chart(title: str, rows: Sequence[Mapping[str, Any]]) -> Chart | None:
    """Shares of the queries by the score of their best true match and of their best wrong answer; None where none has both.

    A wrong answer that is not among the top ten is worth less than these, and is left out.
    """
    right, wrong = best_scores(rows)
    if not right or not wrong:
        return None
    low, high = min(*right, *wrong), max(*right, *wrong)
    x_ticks = nice_ticks(low, high)
    edges = np.linspace(x_ticks[0], x_ticks[-1], BINS + 1)
    shares = {
        name: np.histogram(scores, edges)[0] / len(scores) for name, scores in (("wrong", wrong), ("right", right))
    }
    y_ticks = nice_ticks(0, float(max(share.max() for share in shares.values())))
    frame = Frame(x_ticks[0], x_ticks[-1], 0, y_ticks[-1])
    middles = (edges[:-1] + edges[1:]) / 2
    styles = {"right": "main", "wrong": "beside"}
    return Chart(
        title=title, note="queries by the score of their best true match; dashed: of their best wrong answer",
        summary=f"{title}: median score {np.median(right):.3f} of true matches, {np.median(wrong):.3f} of wrong answers",
        lines=tuple(
            frame.line(f"best {name} answer", styles[name], list(zip(middles.tolist(), share.tolist(), strict=True)))
            for name, share in shares.items()
        ),
        x_ticks=tuple(Tick(at=frame.x(x), label=f"{x:g}") for x in x_ticks),
        y_ticks=tuple(Tick(at=frame.y(y), label=f"{100 * y:g} %") for y in y_ticks),
    )  # fmt: skip


def best_scores(rows: Sequence[Mapping[str, Any]]) -> tuple[list[float], list[float]]:
    """Scores of the best true match and of the best wrong answer, of the queries that have one."""
    right = [row["first_match_score"] for row in rows if row["first_match_score"] is not None]
    return right, [score for row in rows if (score := _best_wrong(row)) is not None]


def _best_wrong(row: Mapping[str, Any]) -> float | None:
    answers = zip(row["top_locations"], row["top_scores"], strict=True)
    return next((score for location, score in answers if location != row["location"]), None)
