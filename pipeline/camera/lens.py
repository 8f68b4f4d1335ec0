"""The field of view from what a photo's tags say of its lens.

In: focal lengths as cameras state them. Out: degrees across the width, or None. The 35 mm
equivalent is defined by the diagonal of 36 x 24 mm [CIPA DCG-001, section 4].
"""

import math

DIAGONAL_35MM = math.hypot(36.0, 24.0)
"Millimetres."
SENSOR_WIDTH_MM = {
    "FC220": 6.17,  # Mavic Pro
    "FC300": 6.17,  # Phantom 3
    "FC330": 6.17,  # Phantom 4
    "FC350": 6.17,  # Inspire 1, Zenmuse X3
    "FC550": 17.3,  # Zenmuse X5
    "FC6310": 13.2,  # Phantom 4 Pro
    "FC6510": 13.2,  # Zenmuse X4S
    "FC6520": 17.3,  # Zenmuse X5S
    "FC6540": 23.5,  # Zenmuse X7
    "FC7203": 6.17,  # Mavic Mini
    "FC3170": 6.4,  # Mavic Air 2
    "FC3411": 13.2,  # Air 2S
    "L1D-20C": 13.2,  # Mavic 2 Pro
    "L2D-20C": 17.3,  # Mavic 3
    "M3E": 17.3,  # Mavic 3 Enterprise
    "ZENMUSEP1": 35.9,
    "EVO II": 6.4,
}
"""Widths of sensors by the beginning of the camera's model, in capitals, for cameras that state
their focal length only. Data sheets of the makers."""


def field_of_view(
    size: tuple[int, int],
    *,
    focal_px: float | None = None,
    focal_35mm: float | None = None,
    focal_mm: float | None = None,
    model: str = "",
) -> float | None:
    """Degrees across the width of a photo of `size` (width, height) pixels; None where unknown.

    Taken in this order: a calibrated focal length in pixels, the 35 mm equivalent, the focal length
    in millimetres over the model's sensor (SENSOR_WIDTH_MM, longest name first).
    """
    width, height = size
    if focal_px and focal_px > 0:
        return _across(width / focal_px)
    if focal_35mm and focal_35mm > 0:
        share = width / math.hypot(width, height)
        return _across(DIAGONAL_35MM * share / focal_35mm)
    name = model.strip().upper()
    known = [sensor for sensor in SENSOR_WIDTH_MM if name.startswith(sensor)]
    if focal_mm and focal_mm > 0 and known:
        # The sensor's width is its longer side, whichever way the photo was turned.
        sensor_mm = SENSOR_WIDTH_MM[max(known, key=len)] * width / max(size)
        return _across(sensor_mm / focal_mm)
    return None


def focal_length_35mm(fov_deg: float, size: tuple[int, int]) -> float:
    """The 35 mm equivalent, millimetres, of a field of view across the width of a photo of `size`
    (width, height)."""
    share = size[0] / math.hypot(*size)
    return DIAGONAL_35MM * share / 2 / math.tan(math.radians(fov_deg) / 2)


def _across(width_per_focal_length: float) -> float:
    return math.degrees(2 * math.atan(width_per_focal_length / 2))
