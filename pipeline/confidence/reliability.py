"""Whether probabilities are calibrated: reliability bins, the expected calibration error, and the
reliability diagram as SVG.

In: predicted probabilities and observed outcomes. Out: numbers and a picture. NumPy only, no I/O.
Shapes: N examples.
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
    """Examples with similar probabilities."""

    predicted: float
    "Their mean probability."
    observed: float
    "The share of them that was right."
    share: float
    "Their share of all examples, by weight."


def reliability_bins(
    predicted_N: Doubles, observed_N: Doubles, weight_N: Doubles
) -> list[ReliabilityBin]:
    """The bins of equal width from 0 to 1 that contain any example."""
    bin_N = np.minimum((predicted_N * BIN_COUNT).astype(np.int64), BIN_COUNT - 1)
    bins = []
    for number in np.unique(bin_N):
        inside_N = bin_N == number
        weight = weight_N[inside_N]
        predicted, observed = (
            float(np.average(values[inside_N], weights=weight))
            for values in (predicted_N, observed_N)
        )
        share = float(weight.sum() / weight_N.sum())
        bins.append(ReliabilityBin(predicted=predicted, observed=observed, share=share))
    return bins


def expected_calibration_error(bins: Sequence[ReliabilityBin]) -> float:
    """Mean distance of predicted and observed, weighted by share (Naeini et al. 2015)."""
    return sum(one.share * abs(one.predicted - one.observed) for one in bins)


def reliability_diagram(bins: Sequence[ReliabilityBin], title: str) -> str:
    """The reliability diagram: one dot a bin, its area the bin's share of examples; a calibrated
    model has all dots on the dashed line."""
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
        f'<circle cx="{x(one.predicted)}" cy="{y(one.observed)}" r="{2 + 16 * one.share**0.5:.1f}">'
        f"<title>predicted {one.predicted:.3f}, observed {one.observed:.3f}, {one.share:.1%} of the"
        " answers</title></circle>"
        for one in bins
    )
    box = f"0 0 {DIAGRAM_SIDE + 20} {inner + 56}"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{box}" width="{2 * DIAGRAM_SIDE}" '
        f'role="img" aria-label="{html.escape(title)}" font-family="sans-serif" font-size="11" '
        f'fill="#5d666f"><rect width="100%" height="100%" fill="#fff"/>'
        f'<rect x="{x(0)}" y="{y(1)}" width="{inner}" height="{inner}" fill="none" '
        f'stroke="#e3e0d8"/><path d="M{x(0)} {y(0)}L{x(1)} {y(1)}" stroke="#5d666f" '
        f'stroke-dasharray="3 4"/>'
        f'<g fill="#1f5c99" fill-opacity=".55" stroke="#1f5c99">{dots}</g>{ticks}'
        f'<text x="{x(0.5)}" y="{inner + 46}" text-anchor="middle">predicted probability</text>'
        f'<text transform="translate(12 {y(0.5)}) rotate(-90)" text-anchor="middle">'
        f"share that was right</text></svg>\n"
    )
