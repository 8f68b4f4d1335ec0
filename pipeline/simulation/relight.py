"""The sun of a photograph: an image from above and its heights come in; the day that lit it, and
its colours without that light, go out.

Heights and a sun tell where shadows fall. The sun whose shadows are the darkest ground of the image
is taken for the one that lit it; its light is then divided out, and another day's can fall on the
same ground.

Letters: H, W pixels of the map; 3 red, green, blue.
"""

from functools import partial

import cv2
import numpy as np

from pipeline.core.arrays import Mask
from pipeline.simulation.appearance import SHADOW_EDGE_M, Day, daylight
from pipeline.simulation.shadows import cast_shadows
from pipeline.simulation.world import ByteMap, FloatMap

SUN_PIXEL_M = 1.0
"Side of a pixel of the smaller image that the sun is looked for in, metres."
AZIMUTHS_DEG, ELEVATIONS_DEG, APART_DEG = range(0, 360, 30), (25, 40, 55), (30.0, 15.0)
HALVINGS = 3
"Suns that are tried, and how far apart; around the best of them others, so often half as far."
LEAST_CORRELATION = 0.15
"Of shadow and darkness: below it no sun is found; the sky was covered, or the heights lie beside."
BESIDE_M = 4.0
"Ground so near to a shadow is taken for the same ground in the sun."
DARKEST, LIGHTEST = 0.15, 0.9
"Light in a shadow, as a share of the sun's: no less, and no sun is found where there is more."
LEAST_LIGHT = 0.2
"That colours are divided by."


def find_day(texture_HW3: ByteMap, height_HW: FloatMap, metres_per_pixel: float) -> Day | None:
    """The day by whose sun the image's shadows fall; None where none is found."""
    if not height_HW.any():
        return None
    shrink = max(1.0, SUN_PIXEL_M / metres_per_pixel)
    rows, columns = (max(1, round(side / shrink)) for side in height_HW.shape)
    small = partial(cv2.resize, dsize=(columns, rows), interpolation=cv2.INTER_AREA)
    height_hw = np.asarray(small(height_HW), np.float32)
    dark_hw = -np.log(np.asarray(small(texture_HW3), np.float32).mean(axis=2) + 8)
    pixel_m = metres_per_pixel * shrink

    def correlation(sun: tuple[float, float]) -> float:
        shadow_hw = _shadow(height_hw, pixel_m, *sun)
        if shadow_hw.all() or not shadow_hw.any():
            return 0.0
        return float(np.corrcoef(shadow_hw.ravel(), dark_hw.ravel())[0, 1])

    if float(np.std(dark_hw)) == 0:
        return None
    suns = [(float(azimuth), float(up)) for azimuth in AZIMUTHS_DEG for up in ELEVATIONS_DEG]
    best = max(suns, key=correlation)
    for halving in range(1, HALVINGS + 1):
        turn, rise = (apart / 2**halving for apart in APART_DEG)
        around = [(best[0] + a * turn, best[1] + e * rise) for a in (-1, 0, 1) for e in (-1, 0, 1)]
        best = max(around, key=correlation)
    if correlation(best) < LEAST_CORRELATION:
        return None
    shade = _shade(_shadow(height_hw, pixel_m, *best), dark_hw, pixel_m)
    if shade > LIGHTEST:
        return None
    azimuth, elevation = best
    return Day(sun_azimuth_deg=azimuth % 360, sun_elevation_deg=elevation, shade=shade)


def without_light(
    texture_HW3: ByteMap, height_HW: FloatMap, metres_per_pixel: float, day: Day
) -> ByteMap:
    """The colours (H, W, 3) that the day's light fell on."""
    top_HW = cast_shadows(height_HW, metres_per_pixel, toward_sun=day.toward_sun())
    light_HW3 = daylight(height_HW, top_HW, metres_per_pixel, day)
    colour_HW3 = texture_HW3 / np.maximum(light_HW3, np.float32(LEAST_LIGHT))
    return np.clip(colour_HW3 + 0.5, 0, 255).astype(np.uint8)


def _shadow(height_hw: FloatMap, pixel_m: float, azimuth_deg: float, elevation_deg: float) -> Mask:
    day = Day(sun_azimuth_deg=azimuth_deg, sun_elevation_deg=elevation_deg)
    top_hw = cast_shadows(height_hw, pixel_m, toward_sun=day.toward_sun())
    return np.asarray(top_hw - height_hw > SHADOW_EDGE_M / 2)


def _shade(shadow_hw: Mask, dark_hw: FloatMap, pixel_m: float) -> float:
    """Light in the shadows as a share of that on the ground beside them."""
    reach = 2 * max(1, round(BESIDE_M / pixel_m)) + 1
    near_hw = cv2.dilate(shadow_hw.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
    beside_hw = near_hw & ~shadow_hw
    if not beside_hw.any():
        return 1.0
    ratio = np.exp(np.median(dark_hw[beside_hw]) - np.median(dark_hw[shadow_hw]))
    return max(DARKEST, float(ratio))
