"""Images of a world on one day: straight down like a satellite, or in perspective like a UAV.

A ray is a line in the height z: its column and row on the map are `a + b * z`. All rays of a frame
descend together, in steps of one map pixel, from just above the highest surface that a coarse map
of maxima allows; three bisections then locate the hit.

Letters: H, W pixels of the padded map; h, w its coarse maxima; N rays along a side of the frame; S
pixels along it; 3 red, green, blue; K facades.
"""

from math import cos, radians, sin, tan

import numpy as np
from numpy.typing import NDArray

from pipeline.camera.pose import Pose
from pipeline.simulation.scene import COARSE_CELL_PX, Scene
from pipeline.simulation.walls import wall_colours
from pipeline.simulation.world import ByteMap, FloatMap

RAYS_PER_PIXEL = 2
"""Rays along each side of a pixel: 4 in all, averaged."""
BUNDLE_SIDE = 4
"""Rays along a side of a bundle that starts together; its footprint has to fit a coarse cell."""
BAND_RAYS = 65_536
"""Rays of a band: a dozen arrays of this size fit a core's cache."""
BUNDLE_STEP_PX = 3.0
"""Map pixels between two lookups of a bundle in the coarse map."""
LONGEST_FALL_M = 2.0
"""Metres that a ray descends in one step, at most: the bisections then still tell the top of a
surface from a wall."""
WALL_DEPTH_M = 0.35
"""A hit so far below the surface's top is on a wall."""

Indices = NDArray[np.int32]


def render_nadir(
    scene: Scene,
    *,
    size: int,
    half_m: float,
    shift_m: tuple[float, float] = (0.0, 0.0),
    turn_deg: float = 0.0,
    rng: np.random.Generator | None = None,
) -> ByteMap:
    """A square of side 2 * half_m metres around `shift_m` from straight above, (S, S, 3), north up.

    `turn_deg` turns the image clockwise. With `rng`, the sensor adds noise.
    """
    n = size * RAYS_PER_PIXEL
    mpp = scene.metres_per_pixel
    axis = ((np.arange(n, dtype=np.float32) + np.float32(0.5)) / n * 2 - 1) * np.float32(
        half_m / mpp
    )
    c, s = np.float32(cos(radians(turn_deg))), np.float32(sin(radians(turn_deg)))
    cols = c * axis[None, :] + s * axis[:, None] + np.float32(scene.origin + shift_m[0] / mpp)
    rows = c * axis[:, None] - s * axis[None, :] + np.float32(scene.origin - shift_m[1] / mpp)
    cells = _flat_indices(rows, cols, scene.packed_HW.shape[1])
    return _apply_sensor(scene, scene.packed_HW.take(cells, mode="clip"), rng)


def render_perspective(
    scene: Scene, pose: Pose, *, size: int, rng: np.random.Generator | None = None
) -> ByteMap:
    """The frame (S, S, 3) of a pinhole camera at `pose`. With `rng`, the sensor adds noise."""
    n = size * RAYS_PER_PIXEL
    # Bands of rows, a multiple of a bundle high, whose arrays stay in the processor's cache: half
    # the time of all rows at once.
    band = max(BUNDLE_SIDE, BAND_RAYS // n // BUNDLE_SIDE * BUNDLE_SIDE)
    seen_NN = np.empty((n, n), np.uint32)
    for first in range(0, n, band):
        rows = slice(first, min(n, first + band))
        seen_NN[rows] = _trace_band(scene, _rays(scene, pose, n, rows))
    return _apply_sensor(scene, seen_NN, rng)


def _trace_band(
    scene: Scene, rays: tuple[FloatMap, FloatMap, FloatMap, FloatMap]
) -> NDArray[np.uint32]:
    """Packed colours at the hits of a band's rays."""
    col_a, col_b, row_a, row_b = rays
    # Metres down per map pixel along; a vertical ray would fall for ever.
    along = np.sqrt(col_b * col_b + row_b * row_b)
    fall = 1 / np.maximum(along, np.float32(1 / LONGEST_FALL_M))
    z = _bundle_start(scene, col_a, col_b, row_a, row_b, fall)
    flat = [a.ravel() for a in (col_a, col_b, row_a, row_b, fall)]
    above, below = _march(scene, z.ravel(), *flat)
    width = scene.height_HW.shape[1]
    cells = _flat_indices(flat[2] + flat[3] * below, flat[0] + flat[1] * below, width)
    seen = scene.packed_HW.take(cells, mode="clip")
    walls = np.nonzero(scene.height_HW.take(cells, mode="clip") - below > WALL_DEPTH_M)[0]
    if walls.size:
        z_walls, hit = above[walls], cells[walls]
        before = _flat_indices(
            flat[2][walls] + flat[3][walls] * z_walls,
            flat[0][walls] + flat[1][walls] * z_walls,
            width,
        )
        seen[walls] = wall_colours(
            scene.facades,
            scene.day,
            z=z_walls,
            under=seen[walls],
            height=scene.height_HW.take(hit, mode="clip"),
            facade=scene.facade_HW.take(hit, mode="clip"),
            along=scene.along_HW.take(hit, mode="clip"),
            facing=scene.facing_HW.take(hit, mode="clip"),
            shadow_top=scene.shadow_top_HW.take(before, mode="clip"),
        )
    return seen.reshape(col_a.shape)


def _rays(
    scene: Scene, pose: Pose, n: int, rows: slice
) -> tuple[FloatMap, FloatMap, FloatMap, FloatMap]:
    """(col_a, col_b, row_a, row_b) of a band: at height z a ray is at column col_a + col_b * z."""
    axis = ((np.arange(n, dtype=np.float32) + np.float32(0.5)) / n * 2 - 1) * np.float32(
        tan(radians(pose.fov_deg) / 2)
    )
    heading, pitch = radians(pose.heading_deg), radians(pose.pitch_deg)
    up = -axis[rows, None]
    level = np.float32(cos(pitch)) - up * np.float32(sin(pitch))
    down = np.float32(sin(pitch)) + up * np.float32(cos(pitch))
    if float(down.max()) >= -0.05:
        raise ValueError(
            f"pitch {pose.pitch_deg} with a field of view of {pose.fov_deg} degrees sees the "
            "horizon: look further down or narrow the lens"
        )
    forward, side = level / down, axis[None, :] / down
    east = np.float32(sin(heading)) * forward + np.float32(cos(heading)) * side
    north = np.float32(cos(heading)) * forward - np.float32(sin(heading)) * side
    per_m = np.float32(1 / scene.metres_per_pixel)
    col_b, row_b = east * per_m, north * -per_m
    col_a = np.float32(scene.origin + pose.x_m * per_m) - np.float32(pose.altitude_m) * col_b
    row_a = np.float32(scene.origin - pose.y_m * per_m) - np.float32(pose.altitude_m) * row_b
    return col_a, col_b, row_a, row_b


def _bundle_start(
    scene: Scene, col_a: FloatMap, col_b: FloatMap, row_a: FloatMap, row_b: FloatMap, fall: FloatMap
) -> FloatMap:
    """Start heights of the rays: low, but above any surface that a ray of the bundle can hit."""
    top = np.float32(scene.height_HW.max() + 0.01)
    spread = _footprint(col_a, row_a)
    bundle = BUNDLE_SIDE if spread * BUNDLE_SIDE / 2 + BUNDLE_STEP_PX <= COARSE_CELL_PX else 1
    if bundle == 1 and spread + BUNDLE_STEP_PX > COARSE_CELL_PX:
        return np.full_like(col_a, top)
    middle = slice(bundle // 2, None, bundle)
    ca, cb, ra, rb = (
        m[middle, middle] * np.float32(1 / COARSE_CELL_PX) for m in (col_a, col_b, row_a, row_b)
    )
    step = fall[middle, middle] * np.float32(BUNDLE_STEP_PX)
    z = np.full_like(ca, top)
    width = scene.coarse_hw.shape[1]
    while True:
        highest = scene.coarse_hw.take(_flat_indices(ra + rb * z, ca + cb * z, width), mode="clip")
        lower = z - step
        free = highest < lower
        if not free.any():
            break
        z = np.where(free, lower, z)
    z = np.minimum(z, np.maximum(highest + np.float32(0.01), lower))
    start: FloatMap = z.repeat(bundle, axis=0).repeat(bundle, axis=1)
    return start


def _footprint(col_a: FloatMap, row_a: FloatMap) -> float:
    """Longest ground distance between neighbouring rays, map pixels: at the frame's far corners."""
    return max(
        float(np.hypot(col_a[r, c] - col_a[r + 1, c + 1], row_a[r, c] - row_a[r + 1, c + 1]))
        for r in (0, -2)
        for c in (0, -2)
    )


def _march(
    scene: Scene,
    z: FloatMap,
    col_a: FloatMap,
    col_b: FloatMap,
    row_a: FloatMap,
    row_b: FloatMap,
    fall: FloatMap,
) -> tuple[FloatMap, FloatMap]:
    """Heights just above and just below the surface along each ray."""
    height_HW, width = scene.height_HW, scene.height_HW.shape[1]
    z = z.copy()
    live: NDArray[np.intp] | None = None
    now, rays = z, (col_a, col_b, row_a, row_b, fall)
    while True:
        ca, cb, ra, rb, step = rays
        for _ in range(3):
            # A ray that has hit a surface stays and hits it again: no mask is needed.
            lower = now - step
            free = (
                height_HW.take(_flat_indices(ra + rb * lower, ca + cb * lower, width), mode="clip")
                < lower
            )
            now = np.where(free, lower, now)
        left = np.nonzero(free)[0]
        if live is None:
            z, live = now, left
        else:
            z[live] = now
            live = live[left]
        if live.size == 0:
            break
        now = now[left]
        rays = (ca[left], cb[left], ra[left], rb[left], step[left])
    above, below = z, z - fall
    for _ in range(3):
        middle = (above + below) * np.float32(0.5)
        hit = (
            height_HW.take(
                _flat_indices(row_a + row_b * middle, col_a + col_b * middle, width), mode="clip"
            )
            >= middle
        )
        below = np.where(hit, middle, below)
        above = np.where(hit, above, middle)
    return above, below


def _flat_indices(rows: FloatMap, cols: FloatMap, width: int) -> Indices:
    """Flat indices of map positions; positions beyond the padding wrap to other pixels."""
    cells: Indices = rows.astype(np.int32)
    cells *= np.int32(width)
    cells += cols.astype(np.int32)
    return cells


def _apply_sensor(
    scene: Scene, packed_NN: NDArray[np.uint32], rng: np.random.Generator | None
) -> ByteMap:
    """Average the rays of each pixel, add the sensor's noise and apply its curve: (S, S, 3)."""
    # Red and blue are summed in one number: the sum of four bytes fits the 16 bits between them.
    odd = packed_NN & np.uint32(0x00FF00FF)
    even = (packed_NN >> np.uint32(8)) & np.uint32(0xFF)
    odd = odd[0::2] + odd[1::2]
    even = even[0::2] + even[1::2]
    odd = odd[:, 0::2] + odd[:, 1::2]
    even = even[:, 0::2] + even[:, 1::2]
    frame_SS3 = np.empty((*odd.shape, 3), np.int16)
    frame_SS3[..., 0] = (odd & np.uint32(0xFFFF)) >> np.uint32(2)
    frame_SS3[..., 1] = even >> np.uint32(2)
    frame_SS3[..., 2] = odd >> np.uint32(18)
    if rng is not None and scene.day.noise > 0:
        frame_SS3 += _noise(rng, frame_SS3.shape[0], scene.day.noise)[..., None]
    np.clip(frame_SS3, 0, 255, out=frame_SS3)
    out_SS3 = np.empty(frame_SS3.shape, np.uint8)
    for c in range(3):
        scene.curve_3V[c].take(frame_SS3[..., c], out=out_SS3[..., c], mode="clip")
    return out_SS3


def _noise(rng: np.random.Generator, size: int, strength: float) -> NDArray[np.int16]:
    """Noise (S, S) of about this standard deviation: a sum of bytes, several times cheaper than
    normal deviates.
    """
    raw = np.frombuffer(rng.bytes(size * size * 4), np.uint8).reshape(4, size, size)
    # Four uniform bytes have a standard deviation of 2 * 256 / sqrt(12) = 147.8.
    total = raw.sum(axis=0, dtype=np.int16) - np.int16(510)
    noise: NDArray[np.int16] = (total * np.float32(strength / 147.8)).astype(np.int16)
    return noise
