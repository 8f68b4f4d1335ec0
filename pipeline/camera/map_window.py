"""Tiles of a map -> one north-up window of it around a position.

In: tiles, whose pixels are read when needed, and the positions of their corners. Out: a square of
pixels with a known ground. Shapes: H, W pixels, 3 = red, green, blue; T tiles; C cells along a
window's side; N points, 2 = column, row, or east, north.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.camera.ground import apply_homography, corners
from pipeline.camera.local_plane import LocalPlane
from pipeline.camera.warp import north_up, shrink_first
from pipeline.core.arrays import Doubles, Pixels

Footprint = npt.ArrayLike
"Corners (4, 2), latitude and longitude, from the image's upper left clockwise."
COVER_CELLS = 48
"Cells along a window's side by which tiles are chosen that together show it."


@dataclass(frozen=True, kw_only=True)
class MapWindow:
    """A square of the map, north up, around the zero of its plane."""

    pixels_HW3: Pixels
    "Black where no tile shows the ground."
    shown_HW: Pixels
    "255 where a tile shows the ground, else 0."
    metres_per_pixel: float
    plane: LocalPlane

    @property
    def to_ground_33(self) -> Doubles:
        """The homography from its pixels to (east, north) in metres."""
        half_m = len(self.pixels_HW3) / 2 * self.metres_per_pixel
        scale = self.metres_per_pixel
        return np.array([[scale, 0, -half_m], [0, -scale, half_m], [0, 0, 1]])


@dataclass(frozen=True, kw_only=True)
class Tile:
    """An image of the map and the ground that it shows."""

    read: Callable[[], Pixels | None]
    "Its pixels (H, W, 3); None of a damaged one."
    footprint: Footprint
    metres_per_pixel: float


def compose_window(
    plane: LocalPlane, tiles: Sequence[Tile], half_m: float, metres_per_pixel: float
) -> MapWindow:
    """The ground within `half_m` east, west, north and south of the plane's zero, from the tiles
    that show it: where several do, from one of the finest. Of tiles that overlap, those are read
    that add ground."""
    side = max(1, round(2 * half_m / metres_per_pixel))
    pixels_HW3, shown_HW = np.zeros((side, side, 3), np.uint8), np.zeros((side, side), np.uint8)
    to_window_33 = north_up(1 / metres_per_pixel, -half_m, half_m)
    targets_T42 = [
        apply_homography(to_window_33, plane.to_metres(np.asarray(tile.footprint, np.float64)))
        for tile in tiles
    ]
    for number in _order(tiles, targets_T42, side):
        target_42 = targets_T42[number]
        least, most = np.floor(target_42.min(axis=0)), np.ceil(target_42.max(axis=0))
        (left, top), (right, bottom) = (
            np.clip(edge, 0, side).astype(int).tolist() for edge in (least, most)
        )
        if right <= left or bottom <= top or shown_HW[top:bottom, left:right].all():
            continue
        tile_HW3 = tiles[number].read()
        if tile_HW3 is None:
            continue
        patch_HW3, inside_HW = _draw(tile_HW3, target_42 - (left, top), right - left, bottom - top)
        new_HW = inside_HW & (shown_HW[top:bottom, left:right] == 0)
        pixels_HW3[top:bottom, left:right][new_HW] = patch_HW3[new_HW]
        shown_HW[top:bottom, left:right][new_HW] = 255
    return MapWindow(
        pixels_HW3=pixels_HW3, shown_HW=shown_HW, metres_per_pixel=metres_per_pixel, plane=plane
    )  # fmt: skip


def _order(tiles: Sequence[Tile], targets_T42: Sequence[Doubles], side: int) -> list[int]:
    """Numbers of the tiles: the finest first; of equally fine ones first those that add the most
    ground, so that few of those that overlap have to be read."""
    middles_C = (np.arange(COVER_CELLS) + 0.5) * side / COVER_CELLS
    shows_TCC = np.zeros((len(tiles), COVER_CELLS, COVER_CELLS), np.bool_)
    for shows_CC, target_42 in zip(shows_TCC, targets_T42, strict=True):
        (left, top), (right, bottom) = target_42.min(axis=0), target_42.max(axis=0)
        rows_C = (middles_C > top) & (middles_C < bottom)
        shows_CC[:] = rows_C[:, None] & ((middles_C > left) & (middles_C < right))
    fineness_T = np.round(np.log2([tile.metres_per_pixel for tile in tiles]), 1)
    order: list[int] = []
    for fineness in np.unique(fineness_T):
        left_T = np.flatnonzero(fineness_T == fineness)
        bare_CC = ~shows_TCC[order].any(axis=0)
        while len(left_T):
            added_T = (shows_TCC[left_T] & bare_CC).sum(axis=(1, 2))
            best = int(added_T.argmax())
            if added_T[best] == 0:
                order += left_T.tolist()
                break
            order.append(int(left_T[best]))
            bare_CC &= ~shows_TCC[left_T[best]]
            left_T = np.delete(left_T, best)
    return order


def _draw(pixels_HW3: Pixels, target_42: Doubles, width: int, height: int) -> tuple[Pixels, Any]:
    """A tile drawn with its corners at `target_42`, and where it covers its patch."""
    shrink = float(np.linalg.norm(target_42[1] - target_42[0])) / pixels_HW3.shape[1]
    pixels_HW3, _ = shrink_first(pixels_HW3, shrink)
    source_42 = corners((pixels_HW3.shape[1], pixels_HW3.shape[0]))
    # OpenCV counts from the middle of the first pixel.
    to_patch_33 = cv2.getPerspectiveTransform(
        (source_42 - 0.5).astype(np.float32), (target_42 - 0.5).astype(np.float32)
    )
    patch_HW3 = cv2.warpPerspective(
        pixels_HW3, to_patch_33, (width, height), flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    inside_HW = np.zeros((height, width), np.uint8)
    cv2.fillConvexPoly(inside_HW, np.round(target_42 * 16 - 8).astype(np.int32), 1, shift=4)
    return np.asarray(patch_HW3, np.uint8), inside_HW > 0
