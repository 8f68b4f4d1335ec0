"""Whether probabilities mean what they say: said and seen by bins, the expected calibration error,
and the diagram as SVG.

In: probabilities and what came true. Out: numbers and a picture. NumPy only, no I/O. Shapes: N
examples, B bins.
"""

import html
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Doubles

BIN_COUNT = 10
DIAGRAM_SIDE, DIAGRAM_MARGIN = 260, 56


@dataclass(frozen=True, kw_only=True)
class ReliabilityBin:
    """Examples with much the same probability."""

    said: float
    "Their mean probability."
    seen: float
    "The share of them that came true."
    share: float
    "Of all examples, by weight."


def reliability_bins(said_N: Doubles, true_N: Doubles, weight_N: Doubles) -> list[ReliabilityBin]:
    """The bins of equal width from 0 to 1 that hold any example."""
    bin_N = np.minimum((said_N * BIN_COUNT).astype(np.int64), BIN_COUNT - 1)
    bins = []
    for number in np.unique(bin_N):
        inside_N = bin_N == number
        weight = weight_N[inside_N]
        said, seen = (
            float(np.average(values[inside_N], weights=weight)) for values in (said_N, true_N)
        )
        bins.append(
            ReliabilityBin(said=said, seen=seen, share=float(weight.sum() / weight_N.sum()))
        )
    return bins


def expected_calibration_error(bins: Sequence[ReliabilityBin]) -> float:
    """Expected calibration error: mean distance of said and seen, by the bins' shares (Naeini et
    al. 2015).
    """
    return sum(one.share * abs(one.said - one.seen) for one in bins)


def reliability_diagram(bins: Sequence[ReliabilityBin], title: str) -> str:
    """The reliability diagram: a dot per bin over the probability said, its area the share of
    examples; true is the line.
    """
    inner = DIAGRAM_SIDE - DIAGRAM_MARGIN

    def x(value: float) -> str:
        return f"{DIAGRAM_MARGIN + value * inner:.1f}"

    def y(value: float) -> str:
        return f"{inner + 10 - value * inner:.1f}"

    ticks = "".join(
        f'<text x="{x(at)}" y="{inner + 27}" text-anchor="middle">{at:g}</text>'
        f'<text x="{DIAGRAM_MARGIN - 7}" y="{y(at)}" dy="4" text-anchor="end">{at:g}</text>'
        for at in (0, 0.25, 0.5, 0.75, 1)
    )
    dots = "".join(
        f'<circle cx="{x(one.said)}" cy="{y(one.seen)}" r="{2 + 16 * one.share**0.5:.1f}">'
        f"<title>said {one.said:.3f}, seen {one.seen:.3f}, {one.share:.1%} of the answers</title></circle>"
        for one in bins
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {DIAGRAM_SIDE + 20} {inner + 56}" width="{2 * DIAGRAM_SIDE}" role="img" '
        f'aria-label="{html.escape(title)}" font-family="sans-serif" font-size="11" fill="#5d666f">'
        f'<rect width="100%" height="100%" fill="#fff"/><rect x="{x(0)}" y="{y(1)}" width="{inner}" height="{inner}" '
        f'fill="none" stroke="#e3e0d8"/><path d="M{x(0)} {y(0)}L{x(1)} {y(1)}" stroke="#5d666f" stroke-dasharray="3 4"/>'
        f'<g fill="#1f5c99" fill-opacity=".55" stroke="#1f5c99">{dots}</g>{ticks}'
        f'<text x="{x(0.5)}" y="{inner + 46}" text-anchor="middle">probability said</text>'
        f'<text transform="translate(12 {y(0.5)}) rotate(-90)" text-anchor="middle">share that was right</text></svg>\n'
    )
