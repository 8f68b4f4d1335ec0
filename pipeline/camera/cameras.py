"""The lenses of common UAV cameras by name.

In: a name. Out: degrees across the width of its photo. `lens.py` reads the lens from a photo's
tags; this is for photos that are still to be taken.
"""

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class NamedCamera:
    """A camera of fixed focal length, as its maker's data sheet states it."""

    diagonal_deg: float
    "Field of view across the diagonal, which is what makers state."
    size: tuple[int, int]
    "Width and height of its photo, pixels."

    @property
    def fov_deg(self) -> float:
        """Field of view across the width, without the lens' distortion."""
        share = self.size[0] / math.hypot(*self.size)
        return math.degrees(2 * math.atan(math.tan(math.radians(self.diagonal_deg) / 2) * share))


CAMERAS = {
    "air-2s": NamedCamera(diagonal_deg=88.0, size=(5472, 3648)),
    "matrice-30": NamedCamera(diagonal_deg=84.0, size=(4000, 3000)),
    "mavic-2-pro": NamedCamera(diagonal_deg=77.0, size=(5472, 3648)),
    "mavic-3": NamedCamera(diagonal_deg=84.0, size=(5280, 3956)),
    "mavic-air-2": NamedCamera(diagonal_deg=84.0, size=(4000, 3000)),
    "mavic-mini": NamedCamera(diagonal_deg=83.0, size=(4000, 3000)),
    "mini-2": NamedCamera(diagonal_deg=83.0, size=(4000, 3000)),
    "mini-3": NamedCamera(diagonal_deg=82.1, size=(4000, 3000)),
    "mini-4-pro": NamedCamera(diagonal_deg=82.1, size=(4032, 3024)),
    "phantom-4": NamedCamera(diagonal_deg=94.0, size=(4000, 3000)),
    "phantom-4-pro": NamedCamera(diagonal_deg=84.0, size=(5472, 3648)),
    "zenmuse-h20": NamedCamera(diagonal_deg=82.9, size=(4056, 3040)),
    "zenmuse-p1-24": NamedCamera(diagonal_deg=84.0, size=(8192, 5460)),
    "zenmuse-p1-35": NamedCamera(diagonal_deg=63.5, size=(8192, 5460)),
    "zenmuse-p1-50": NamedCamera(diagonal_deg=46.8, size=(8192, 5460)),
}
"""DJI's cameras, by the data sheets on its site; of several lenses the wide one. The P1's names end
with the focal length of its lens, millimetres."""
