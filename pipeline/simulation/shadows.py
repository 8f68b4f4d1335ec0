"""Cast shadows: a height map and the sun's direction come in, the shadows' heights go out.

Letters: H, W pixels of the map.
"""

import numpy as np

from pipeline.simulation.world import FloatMap


def cast_shadows(
    height_HW: FloatMap, metres_per_pixel: float, *, toward_sun: tuple[float, float, float]
) -> FloatMap:
    """Height (metres) below which each pixel is in shadow.

    That is the maximum over all obstacles toward the sun of their height less the sun's descent.
    `toward_sun` is the unit vector (east, north, up) to the sun. The march doubles its steps, so
    that a shadow of n pixels costs log2(n) passes over the map.
    """
    east, north, up = toward_sun
    reach = max(abs(east), abs(north))
    if reach < 1e-6:  # the sun is overhead
        return np.zeros_like(height_HW)
    step_cols, step_rows = east / reach, -north / reach
    drop = metres_per_pixel * up / reach
    longest = float(height_HW.max()) / drop
    top_HW = _shift_subpixel(height_HW, step_rows, step_cols) - np.float32(drop)
    steps = 1
    while steps < longest:
        further = _shift_subpixel(top_HW, steps * step_rows, steps * step_cols) - np.float32(
            steps * drop
        )
        np.maximum(top_HW, further, out=top_HW)
        steps *= 2
    reached: FloatMap = np.maximum(top_HW, 0)
    return reached


def _shift_subpixel(map_HW: FloatMap, rows: float, cols: float) -> FloatMap:
    """The map shifted by `rows` down and `cols` right, 0 beyond its edge.

    One of the two is an integer; the other is interpolated.
    """
    low_r, low_c = int(np.floor(rows + 1e-6)), int(np.floor(cols + 1e-6))
    part_r, part_c = rows - low_r, cols - low_c
    out = _shift_pixels(map_HW, low_r, low_c)
    blend, next_r, next_c = (part_r, 1, 0) if part_r > part_c else (part_c, 0, 1)
    if blend > 1e-4:
        out += np.float32(blend) * (_shift_pixels(map_HW, low_r + next_r, low_c + next_c) - out)
    return out


def _shift_pixels(map_HW: FloatMap, rows: int, cols: int) -> FloatMap:
    out = np.zeros_like(map_HW)
    h, w = map_HW.shape
    if abs(rows) < h and abs(cols) < w:
        out[max(0, -rows) : h - max(0, rows), max(0, -cols) : w - max(0, cols)] = map_HW[
            max(0, rows) : h - max(0, -rows), max(0, cols) : w - max(0, -cols)
        ]
    return out
