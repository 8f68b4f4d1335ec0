"""The figures that papers printed for University-1652's official test, in percent, to set beside ours: data, no code.

Source: the tables of arXiv 2401.01573 (its own method and, as it quotes them, its peers). Nothing here was measured by us.
"""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Published:
    """One line of the paper's tables; R@1 and AP in percent."""

    method: str
    pixels: int
    drone_to_satellite: tuple[float, float]
    satellite_to_drone: tuple[float, float]

    def of(self, task: str) -> tuple[float, float] | None:
        """R@1 and AP of a task by its name; None where the paper has none."""
        known = {"drone->satellite": self.drone_to_satellite, "satellite->drone": self.satellite_to_drone}
        return known.get(task)


def _line(method: str, pixels: int, *figures: float) -> Published:
    a, b, c, d = figures
    return Published(method=method, pixels=pixels, drone_to_satellite=(a, b), satellite_to_drone=(c, d))


TABLE = (
    _line("Instance loss", 256, 58.49, 63.31, 71.18, 58.74),
    _line("LPN", 256, 75.93, 79.14, 86.45, 74.79),
    _line("USAM", 256, 77.60, 80.55, 86.59, 75.96),
    _line("PCL", 256, 79.47, 83.63, 87.69, 78.51),
    _line("FSRA", 256, 82.25, 84.82, 87.87, 81.53),
    _line("MSBA", 256, 82.33, 84.78, 90.58, 81.61),
    _line("PVDA", 256, 82.73, 85.19, 92.30, 82.48),
    _line("Instance loss", 384, 62.99, 67.69, 75.75, 62.09),
    _line("LCM", 384, 66.65, 70.82, 79.89, 65.38),
    _line("LPN", 384, 78.02, 80.99, 86.16, 76.56),
    _line("PCL", 384, 81.63, 85.46, 89.73, 80.84),
    _line("FSRA", 384, 84.82, 87.03, 87.59, 83.37),
    _line("MSBA", 384, 86.61, 88.55, 92.15, 84.45),
    _line("PVDA", 384, 87.34, 89.26, 93.72, 86.04),
)
ABLATION = (
    _line("PVDA, constant alpha", 256, 82.00, 84.55, 91.73, 81.96),
    _line("PVDA, no restart", 256, 81.54, 84.09, 92.30, 81.05),
)
MULTI_QUERY = {256: (92.01, 98.00, 93.30), 384: (95.29, 98.43, 95.99)}
"Of PVDA, drone->satellite with a location's images as one query: R@1, R@5, AP by image size."
