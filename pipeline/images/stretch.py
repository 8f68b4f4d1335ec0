"""Values deeper than 8 bits -> 8 bits that show something: radiometric thermal (14 bits),
multispectral (10 or 12) and reflectance (fractions) would be black if their upper bits were cut
out.

NumPy only. Shapes: B bands, H x W pixels.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.core.arrays import Pixels

PERCENTILES = (2.0, 98.0)
"Of the values: those that a stretch shows as black and as white."
SAMPLE_VALUES = 1 << 20
"About as many values of an image are sorted for its percentiles, evenly spaced."
FEWEST_LEVELS = 64
"""Of 256: an image of 16 bits a pixel whose upper 8 bits have fewer between its percentiles is
stretched."""


def stretch_of(values: npt.NDArray[Any]) -> tuple[float, float]:
    """The stretch for some valid values: wide enough to divide by, and 0..1 if there are none."""
    if not len(values):
        return 0.0, 1.0
    low, high = (float(value) for value in np.percentile(values, PERCENTILES))
    least = low + 1 if values.dtype.kind in "iu" else np.nextafter(low, np.inf) + 1e-9
    return low, max(high, least)


def to_8bit(
    values_BHW: npt.NDArray[Any], stretch: tuple[float, float] | None, negative: bool = False
) -> Pixels:
    """Values between the two of `stretch` linearly to 0..255, values beyond them clipped; NaN and
    infinity are 0, before a negative is inverted.
    """
    if stretch is None:
        shown_BHW = values_BHW.astype(np.uint8, copy=False)
    else:
        low, high = stretch
        values_BHW = np.where(np.isfinite(values_BHW), values_BHW, low)
        scaled_BHW = np.clip((values_BHW - low) * (255 / (high - low)), 0, 255)
        shown_BHW = np.rint(scaled_BHW).astype(np.uint8)
    return 255 - shown_BHW if negative else shown_BHW


def deep_to_8bit(
    values_HW: npt.NDArray[Any], nodata: float | None = None, negative: bool = False
) -> Pixels:
    """One deep band as (H, W) of 8 bits: its upper 8 bits if it fills 16, else stretched.

    `nodata`: the value of pixels without an image; they are black and do not count.
    """
    valid_HW = np.isfinite(values_HW) if values_HW.dtype.kind == "f" else None
    if nodata is not None:
        known_HW = values_HW != nodata
        valid_HW = known_HW if valid_HW is None else valid_HW & known_HW
    values = values_HW.ravel() if valid_HW is None else values_HW[valid_HW]
    low, high = stretch_of(values[:: max(1, len(values) // SAMPLE_VALUES)])
    if _fills_16_bits(values, high - low):
        shown_HW = (values_HW >> 8).astype(np.uint8)
        shown_HW = 255 - shown_HW if negative else shown_HW
    else:
        shown_HW = to_8bit(values_HW.astype(np.float64), (low, high), negative)
    return shown_HW if valid_HW is None else np.where(valid_HW, shown_HW, np.uint8(0))


def _fills_16_bits(values: npt.NDArray[Any], spread: float) -> bool:
    if values.dtype.kind not in "iu" or not len(values):
        return False
    lowest, highest = int(values.min()), int(values.max())
    return lowest >= 0 and 1 << 15 <= highest < 1 << 16 and spread >= FEWEST_LEVELS << 8
