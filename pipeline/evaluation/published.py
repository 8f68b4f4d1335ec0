"""Figures that papers published for University-1652's official test, to stand beside ours.

In: nothing. Out: rows of R@1 and AP in percent, each with its protocol: figures on the gallery
without distractors (`queried-only`) do not compare with those of the full one. Whether an AP is
possible at all beside its R@1 can be told by arithmetic.
"""

from dataclasses import dataclass
from typing import Literal

from pipeline.core.arrays import Doubles

Protocol = Literal["full", "queried-only"]
ROUNDING = 0.0101
"Percent: figures are published with two decimals, and both are rounded."


@dataclass(frozen=True, kw_only=True)
class PublishedResult:
    """One row of a paper's table; R@1 and AP in percent."""

    method: str
    pixels: int
    drone_to_satellite: tuple[float, float]
    satellite_to_drone: tuple[float, float]
    protocol: Protocol = "full"
    source: str = "arXiv 2401.01573"

    def for_task(self, task: str) -> tuple[float, float] | None:
        """R@1 and AP of a task by its name; None if the paper has none."""
        figures = {
            "drone->satellite": self.drone_to_satellite,
            "satellite->drone": self.satellite_to_drone,
        }
        return figures.get(task)

    @property
    def impossible(self) -> bool:
        """Whether R@1 and AP of drone->satellite, which has one true match, contradict each
        other."""
        return impossible_ap(*self.drone_to_satellite)


def impossible_ap(r1: float, ap: float) -> bool:
    """Whether R@1 and AP in percent contradict each other where a query has one true match.

    Its AP is 1 at rank 1, and at rank 2 or later at most 1/4 (the official measure's trapezoid), so
    that R@1 <= AP <= R@1 + (100 - R@1) / 4. UAV -> satellite on University-1652 is such a task.
    """
    return not r1 - ROUNDING <= ap <= highest_ap(r1) + ROUNDING


def highest_ap(r1: float) -> float:
    """The AP in percent of a task of one true match a query where every miss is at rank 2."""
    return r1 + (100 - r1) / 4


def impossible_means(hits: Doubles, aps: Doubles) -> bool:
    """Whether the means of hits at rank 1 and of AP, shares by query, contradict each other.

    False where a query that hits has an AP below 1: it has further matches, and nothing is known.
    """
    one_match = bool((aps[hits == 1] > 1 - 1e-6).all())
    return one_match and impossible_ap(100 * float(hits.mean()), 100 * float(aps.mean()))


def _published(
    method: str, pixels: int, *figures: float, protocol: Protocol = "full", source: str = ""
) -> PublishedResult:
    a, b, c, d = figures
    return PublishedResult(
        method=method, pixels=pixels, drone_to_satellite=(a, b), satellite_to_drone=(c, d),
        protocol=protocol, source=source or "arXiv 2401.01573",
    )  # fmt: skip


PUBLISHED_TABLE = (
    _published("Instance loss", 256, 58.49, 63.31, 71.18, 58.74),
    _published("LPN", 256, 75.93, 79.14, 86.45, 74.79),
    _published("USAM", 256, 77.60, 80.55, 86.59, 75.96),
    _published("PCL", 256, 79.47, 83.63, 87.69, 78.51),
    _published("FSRA", 256, 82.25, 84.82, 87.87, 81.53),
    _published("MSBA", 256, 82.33, 84.78, 90.58, 81.61),
    _published("PVDA", 256, 82.73, 85.19, 92.30, 82.48),
    _published("Instance loss", 384, 62.99, 67.69, 75.75, 62.09),
    _published("LCM", 384, 66.65, 70.82, 79.89, 65.38),
    _published("LPN", 384, 78.02, 80.99, 86.16, 76.56),
    _published("PCL", 384, 81.63, 85.46, 89.73, 80.84),
    _published("FSRA", 384, 84.82, 87.03, 87.59, 83.37),
    _published("MSBA", 384, 86.61, 88.55, 92.15, 84.45),
    _published("PVDA", 384, 87.34, 89.26, 93.72, 86.04),
)
"The paper's tables 1 and 2."
PUBLISHED_ABLATION = (
    _published("PVDA, constant alpha", 256, 82.00, 84.55, 91.73, 81.96),
    _published("PVDA, no restart", 256, 81.54, 84.09, 92.30, 81.05),
)
"The paper's table of ablations."
PUBLISHED_SINCE = (
    _published("MCCG", 256, 89.64, 91.32, 94.30, 89.39, source="TCSVT 2023"),
    _published(
        "Sample4Geo", 384, 92.65, 93.81, 95.14, 91.39, protocol="queried-only",
        source="arXiv 2303.11851",
    ),
    _published(
        "CAMP", 384, 94.46, 95.38, 96.15, 92.72, protocol="queried-only", source="TGRS 2024"
    ),
    _published(
        "DAC", 384, 94.67, 95.50, 96.43, 93.79, protocol="queried-only", source="TCSVT 2024"
    ),
    _published("QDFL", 280, 95.00, 95.83, 97.15, 94.57, source="TGRS 2025"),
)  # fmt: skip
"Methods after the paper, whose code was read: the protocols are those of their code."
PUBLISHED_MULTI_QUERY = {256: (92.01, 98.00, 93.30), 384: (95.29, 98.43, 95.99)}
"PVDA, drone->satellite with a location's images as one query: R@1, R@5, AP by image size."
