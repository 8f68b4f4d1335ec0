"""Charts that say how far to trust the measures: by number of views, and how scores of right and
wrong answers part.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.report.inputs import EvaluationResults
from pipeline.report.svg import Chart, Frame, Tick, nice_ticks

SCORE_BINS = 24


def views_chart(title: str, rows: Sequence[Mapping[str, Any]]) -> Chart | None:
    """R@1 over the number of views a query is the mean of, with the bounds of its 95 % intervals;
    None without rows.
    """
    if not rows:
        return None
    at = {row["views"]: np.log2(row["views"]) for row in rows}
    frame = Frame(0, max(at.values()), 0, 1)
    dots = [
        (at[row["views"]], row["r1"], f"{row['views']} views: {100 * row['r1']:.2f} %")
        for row in rows
    ]
    lines = [
        frame.line(
            f"95 % interval, {end}",
            "beside",
            [(at[row["views"]], row[f"r1_{end}"]) for row in rows],
        )
        for end in ("low", "high")
    ]
    lines.append(frame.line("R@1", "main", [(x, y) for x, y, _ in dots], dots))
    return Chart(
        title=title,
        note=f"from {rows[0]['queries']:,} queries of one view; dashed: 95 % intervals",
        summary=f"{title}: " + ", ".join(text for _, _, text in dots),
        lines=tuple(lines),
        x_ticks=tuple(Tick(at=frame.x(x), label=str(views)) for views, x in at.items()),
        y_ticks=tuple(Tick(at=frame.y(y), label=f"{100 * y:g} %") for y in (0, 0.25, 0.5, 0.75, 1)),
    )


def scores_chart(title: str, rows: Sequence[Mapping[str, Any]]) -> Chart | None:
    """Shares of the queries by the score of their best true match and of their best wrong answer;
    None where none has both.

    A wrong answer that is not among the top ten is worth less than these, and is left out.
    """
    right, wrong = best_scores(rows)
    if not right or not wrong:
        return None
    low, high = min(*right, *wrong), max(*right, *wrong)
    x_ticks = nice_ticks(low, high)
    edges = np.linspace(x_ticks[0], x_ticks[-1], SCORE_BINS + 1)
    shares = {
        name: np.histogram(scores, edges)[0] / len(scores)
        for name, scores in (("wrong", wrong), ("right", right))
    }
    y_ticks = nice_ticks(0, float(max(share.max() for share in shares.values())))
    frame = Frame(x_ticks[0], x_ticks[-1], 0, y_ticks[-1])
    middles = (edges[:-1] + edges[1:]) / 2
    styles = {"right": "main", "wrong": "beside"}
    return Chart(
        title=title,
        note="queries by the score of their best true match; dashed: of their best wrong answer",
        summary=f"{title}: median score {np.median(right):.3f} of true matches, {np.median(wrong):.3f} of wrong answers",
        lines=tuple(
            frame.line(
                f"best {name} answer",
                styles[name],
                list(zip(middles.tolist(), share.tolist(), strict=True)),
            )
            for name, share in shares.items()
        ),
        x_ticks=tuple(Tick(at=frame.x(x), label=f"{x:g}") for x in x_ticks),
        y_ticks=tuple(Tick(at=frame.y(y), label=f"{100 * y:g} %") for y in y_ticks),
    )


def best_scores(rows: Sequence[Mapping[str, Any]]) -> tuple[list[float], list[float]]:
    """Scores of the best true match and of the best wrong answer, of the queries that have one."""
    right = [row["first_match_score"] for row in rows if row["first_match_score"] is not None]
    return right, [score for row in rows if (score := _best_wrong(row)) is not None]


def _best_wrong(row: Mapping[str, Any]) -> float | None:
    answers = zip(row["top_locations"], row["top_scores"], strict=True)
    return next((score for location, score in answers if location != row["location"]), None)


WIDTH, HEIGHT, MARGIN = 400, 320, 14


@dataclass(frozen=True, kw_only=True)
class Scatter:
    """Points of two views; each view's are one path of the template."""

    title: str
    summary: str
    "The picture in words, for those who cannot see it."
    query_view: str
    gallery_view: str
    dots: str
    "The queries' view: strokes of no length, which round caps make discs."
    triangles: str
    joins: str
    "Thin lines between the two images of a true pair."
    shares: tuple[float, float]
    figures: tuple[tuple[str, str, str], ...]
    "What, its value, and what it means."


def scatter(gap: Mapping[str, Any], beside: EvaluationResults | None = None) -> Scatter:
    """One row of view_gap.json; its figures with those of another evaluation, where that has them.
    Both axes have one scale, as distances in the embedding have."""
    query_view, gallery_view = gap["task"].split("->")
    figures = _figures(gap)
    for other in beside.gaps if beside else ():
        if other["task"] == gap["task"] and beside:
            pairs = zip(figures, _figures(other), strict=True)
            figures = [
                (what, value, f"{meaning}; {beside.name}: {theirs[1]}")
                for (what, value, meaning), theirs in pairs
            ]
    at_S2 = np.array(
        [(point["x"], -point["y"]) for point in gap["points"]]
    )  # SVG's y grows downwards
    low, high = at_S2.min(0), at_S2.max(0)
    room = np.array([WIDTH, HEIGHT]) - 2 * MARGIN
    scale = float((room / np.maximum(high - low, 1e-9)).min())
    xy = [
        (round(x, 1), round(y, 1))
        for x, y in (np.array([WIDTH, HEIGHT]) / 2 + (at_S2 - (low + high) / 2) * scale).tolist()
    ]
    sides = [point["side"] for point in gap["points"]]
    corners = [at for at, side in zip(xy, sides, strict=True) if side == "gallery"]
    return Scatter(
        title=f"{query_view} and {gallery_view} images",
        summary=f"{sides.count('query')} {query_view} and {sides.count('gallery')} {gallery_view} images in two dimensions: "
        + "; ".join(f"{what} {value}" for what, value, _ in figures),
        query_view=query_view,
        gallery_view=gallery_view,
        dots="".join(
            f"M{x} {y}h0" for (x, y), side in zip(xy, sides, strict=True) if side == "query"
        ),
        triangles="".join(f"M{x} {y - 4.2:.1f}l4.2 7h-8.4z" for x, y in corners),
        joins="".join(f"M{xy[i][0]} {xy[i][1]}L{xy[j][0]} {xy[j][1]}" for i, j in gap["joined"]),
        shares=(gap["shares"][0], gap["shares"][1]),
        figures=tuple(figures),
    )


def _figures(gap: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    true, other = gap["true"], gap["other"]
    of_both = " with ".join(gap["task"].split("->"))
    return [
        (
            "Cosine of true pairs",
            _cosine(true),
            f"{of_both} image of one place, {true['pairs']:,} pairs",
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


def _cosine(said: Mapping[str, float]) -> str:
    return f"{said['mean']:.3f} ({said['low']:.2f} to {said['high']:.2f})"
