"""The view gap as a picture: view_gap.describe in, SVG paths and figures in words out."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.report_inputs import Findings

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


def scatter(gap: Mapping[str, Any], beside: Findings | None = None) -> Scatter:
    """One row of view_gap.json; its figures with those of another evaluation, where that has them. Both axes have one scale,
    as distances in the embedding have."""
    query_view, gallery_view = gap["task"].split("->")
    figures = _figures(gap)
    for other in beside.gaps if beside else ():
        if other["task"] == gap["task"] and beside:
            pairs = zip(figures, _figures(other), strict=True)
            figures = [
                (what, value, f"{meaning}; {beside.name}: {theirs[1]}") for (what, value, meaning), theirs in pairs
            ]
    at_S2 = np.array([(point["x"], -point["y"]) for point in gap["points"]])  # SVG's y grows downwards
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
        query_view=query_view, gallery_view=gallery_view,
        dots="".join(f"M{x} {y}h0" for (x, y), side in zip(xy, sides, strict=True) if side == "query"),
        triangles="".join(f"M{x} {y - 4.2:.1f}l4.2 7h-8.4z" for x, y in corners),
        joins="".join(f"M{xy[i][0]} {xy[i][1]}L{xy[j][0]} {xy[j][1]}" for i, j in gap["joined"]),
        shares=(gap["shares"][0], gap["shares"][1]),
        figures=tuple(figures),
    )  # fmt: skip


def _figures(gap: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    true, other = gap["true"], gap["other"]
    of_both = " with ".join(gap["task"].split("->"))
    return [
        ("Cosine of true pairs", _cosine(true), f"{of_both} image of one place, {true['pairs']:,} pairs"),
        ("of other pairs", _cosine(other), f"of different places, {other['pairs']:,}; in brackets 5 to 95 %"),
        (
            "Distance of the views' means",
            f"{gap['distance']:.3f}",
            "in units of a view's spread; 0 where there is no gap",
        ),
        ("Variance shown", f"{100 * sum(gap['shares']):.0f} %", "by the two axes of the picture; the rest is not seen"),
    ]


def _cosine(said: Mapping[str, float]) -> str:
    return f"{said['mean']:.3f} ({said['low']:.2f} to {said['high']:.2f})"
