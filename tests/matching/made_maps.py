"""Made maps, their tiles, and photos of them."""

import io
from collections.abc import Iterable

import cv2
import numpy as np
from PIL import Image

from pipeline.camera.ground import ground_to_photo, looked_at
from pipeline.camera.local_plane import LocalPlane
from pipeline.camera.map_window import MapWindow
from pipeline.camera.pose import Pose
from pipeline.core.arrays import Pixels
from pipeline.core.geo import haversine_m
from pipeline.locate.gallery_map import GalleryMap
from pipeline.matching.map_windows import MapWindows
from pipeline.matching.refine import Refinement

SIDE, METRES_PER_PIXEL, SIZE = 500, 0.3, (320, 240)
TILE_PX = 125
PLANE = LocalPlane(lat=47.0, lon=8.0)
POSE = Pose(
    x_m=-20.0, y_m=-35.0, altitude_m=60.0, heading_deg=30.0, pitch_deg=-60.0, fov_deg=55.0
)  # fmt: skip


def made_map(seed: int, side: int = SIDE) -> Pixels:
    """Rectangles of random colours: corners in plenty."""
    rng = np.random.default_rng(seed)
    image_HW3 = np.full((side, side, 3), 120, np.uint8)
    for _ in range(700 * side**2 // SIDE**2):
        x, y, width, height = (
            int(value) for value in rng.integers((0, 0, 6, 6), (side, side, 40, 40))
        )
        colour = tuple(int(value) for value in rng.integers(0, 256, 3))
        cv2.rectangle(image_HW3, (x, y), (x + width, y + height), colour, -1)
    return np.asarray(cv2.GaussianBlur(image_HW3, (0, 0), 0.8), np.uint8)


def window_of(image_HW3: Pixels) -> MapWindow:
    shown_HW = np.full(image_HW3.shape[:2], 255, np.uint8)
    return MapWindow(
        pixels_HW3=image_HW3, shown_HW=shown_HW, metres_per_pixel=METRES_PER_PIXEL,
        plane=PLANE,
    )  # fmt: skip


def photo_of(window: MapWindow) -> Pixels:
    to_photo_33 = ground_to_photo(POSE, SIZE) @ window.to_ground_33
    half_33 = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    photo_HW3 = cv2.warpPerspective(
        window.pixels_HW3, np.linalg.inv(half_33) @ to_photo_33 @ half_33, SIZE
    )
    return np.asarray(np.clip(0.8 * photo_HW3 + 20, 0, 255), np.uint8)


def error_m(found: Refinement) -> float:
    [[lat, lon]] = PLANE.to_degrees(np.array([looked_at(POSE)]))
    return float(haversine_m(np.array([found.lat, found.lon]), np.array([lat, lon])))


class MadeMap:
    """Tiles of a made map, by key: PNG files, corners and positions."""

    def __init__(self, side: int = SIDE) -> None:
        image_HW3, half_m = made_map(0, side), side / 2 * METRES_PER_PIXEL
        self.pixels_HW3 = image_HW3
        self.images: dict[str, bytes] = {}
        self.corners: dict[str, list[list[float]]] = {}
        middles = []
        for row in range(0, side, TILE_PX):
            for column in range(0, side, TILE_PX):
                key = f"gallery-satellite-{row}-{column}"
                stream = io.BytesIO()
                tile_HW3 = image_HW3[row : row + TILE_PX, column : column + TILE_PX]
                Image.fromarray(tile_HW3).save(stream, "PNG")
                self.images[key] = stream.getvalue()
                west, north = column * METRES_PER_PIXEL - half_m, half_m - row * METRES_PER_PIXEL
                east, south = west + TILE_PX * METRES_PER_PIXEL, north - TILE_PX * METRES_PER_PIXEL
                corners = np.array([[west, north], [east, north], [east, south], [west, south]])
                self.corners[key] = PLANE.to_degrees(corners).tolist()
                middles.append(PLANE.to_degrees(corners.mean(axis=0)[None])[0])
        self.gallery = GalleryMap(
            keys=np.array(list(self.images)),
            locations=np.array(list(self.images)),
            positions_N2=np.array(middles),
            rows=len(middles),
        )

    def fetch(self, keys: Iterable[str]) -> dict[str, bytes]:
        return {key: self.images[key] for key in keys if key in self.images}

    def footprints(self, keys: Iterable[str]) -> dict[str, list[list[float]]]:
        return {key: self.corners[key] for key in keys if key in self.corners}

    def windows(self) -> MapWindows:
        return MapWindows(self.gallery, self.fetch, self.footprints)
