"""Worlds from real overhead images: an image comes in, flat ground with its colours goes out.

The image's middle square is used. Beside `quad.jpg` there may be `quad.height.npy`: a
two-dimensional array of metres above the ground that covers the whole image, at any resolution;
without it the ground is flat. Season, sensor and haze change with the day; so do sun and shadows
where heights show which sun lit the image, else they stay as in it.

Letters: H, W pixels of the map; 3 red, green, blue.
"""

from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from pipeline.core.errors import InputError
from pipeline.images.decode import PILLOW_FORMATS
from pipeline.simulation.appearance import Day
from pipeline.simulation.flight import FlightPlan
from pipeline.simulation.relight import find_day, without_light
from pipeline.simulation.town.town import TEXELS_PER_RADIUS
from pipeline.simulation.world import ByteMap, FloatMap, World

TEXTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")
DECODE_ERRORS = (UnidentifiedImageError, OSError, SyntaxError, Image.DecompressionBombError)
"""Pillow's errors for files that are no images, damaged, or absurdly large."""
MIN_SIDE_PX = 64
"""Images with a shorter side show too little to fly over."""
RADIUS_FRACTION = 0.21
"""Target radius as a fraction of the image's side: the satellite view, and most of the first UAV
frame, stay inside the image.
"""
FLIGHT_OVER_TEXTURE = FlightPlan(depression_start_deg=65.0, depression_end_deg=55.0)
"""Steeper than over towns: flat ground shows no facades, and the image's edge is near."""


def usable_textures(folder: str) -> tuple[list[str], int]:
    """(usable images sorted by path, number of skipped files).

    Raises InputError if the folder is missing or holds no usable image.
    """
    root = Path(folder)
    if not root.is_dir():
        raise InputError(
            f"no folder {folder}; expected a folder of overhead images; check --textures"
        )
    files = sorted(
        path for path in root.rglob("*") if path.is_file() and not path.name.endswith(".height.npy")
    )
    usable = [str(path) for path in files if _is_usable(path)]
    if not usable:
        raise InputError(
            f"{folder} holds {len(files)} files and none is an image of at least {MIN_SIDE_PX} "
            f"pixels a side; expected overhead images ({', '.join(TEXTURE_SUFFIXES)}); "
            "check --textures"
        )
    return usable, len(files) - len(usable)


def _is_usable(path: Path) -> bool:
    if not path.name.lower().endswith(TEXTURE_SUFFIXES):
        return False
    try:
        with Image.open(path, formats=PILLOW_FORMATS) as image:
            least = min(image.size)
            # Truncation shows only in decoding; for a JPEG, decoding at an eighth of its size is
            # enough.
            image.draft("RGB", (MIN_SIDE_PX, MIN_SIDE_PX))
            image.load()
    except DECODE_ERRORS:
        return False
    return least >= MIN_SIDE_PX


def textured_world(path: str, *, metres_per_pixel: float, frame_pixels: int = 256) -> World:
    """The world of one image, with the detail that frames of `frame_pixels` need.

    `metres_per_pixel` is the image's own. Raises InputError for an unreadable image or height map.
    """
    try:
        with Image.open(path, formats=PILLOW_FORMATS) as opened:
            image = opened.convert("RGB")
    except DECODE_ERRORS as error:
        raise InputError(
            f"{path} cannot be decoded ({error}); expected an image; take it out of --textures"
        ) from None
    square = min(image.size)
    left, top = (image.width - square) // 2, (image.height - square) // 2
    extent_m = square * metres_per_pixel
    side = round(TEXELS_PER_RADIUS / RADIUS_FRACTION * frame_pixels / 256)
    box = (left, top, left + square, top + square)
    texture_HW3 = np.asarray(image.resize((side, side), Image.Resampling.BICUBIC, box=box))
    height_HW = _read_heights(path, image.size, box, side)
    pixel_m = extent_m / side
    return photographed_world(
        texture_HW3,
        height_HW,
        metres_per_pixel=pixel_m,
        target_radius_m=RADIUS_FRACTION * extent_m,
        day=find_day(texture_HW3, height_HW, pixel_m),
    )


def photographed_world(
    texture_HW3: ByteMap,
    height_HW: FloatMap,
    *,
    metres_per_pixel: float,
    target_radius_m: float,
    day: Day | None,
) -> World:
    """The world of a photograph from above with heights in metres: without the light of the day
    that it is known to be from, else with its light."""
    if day is not None:
        texture_HW3 = without_light(texture_HW3, height_HW, metres_per_pixel, day)
    grass_HW, trees_HW = _vegetation(texture_HW3.astype(np.float32))
    shape = height_HW.shape
    return World(
        texture_HW3=texture_HW3,
        height_HW=height_HW,
        metres_per_pixel=metres_per_pixel,
        target_radius_m=target_radius_m,
        grass_HW=(grass_HW * 255).astype(np.uint8),
        trees_HW=(trees_HW * 255).astype(np.uint8),
        facade_HW=np.zeros(shape, np.uint8),
        along_HW=np.zeros(shape, np.float32),
        facing_HW=np.zeros(shape, np.float32),
        light_is_baked=day is None,
    )


def _read_heights(
    path: str, size: tuple[int, int], box: tuple[int, int, int, int], side: int
) -> FloatMap:
    """Heights (H, W) in metres from the array beside the image; zero without one."""
    beside = Path(path).with_suffix(".height.npy")
    if not beside.exists():
        return np.zeros((side, side), np.float32)
    try:
        heights = np.load(beside, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise InputError(
            f"{beside} cannot be read ({error}); expected an array as numpy.save writes it"
        ) from None
    if heights.ndim != 2 or heights.dtype.kind not in "fiu" or not np.isfinite(heights).all():
        raise InputError(
            f"{beside} holds {heights.dtype} of shape {heights.shape}; expected two dimensions of "
            "finite metres; write it again or remove it"
        )
    across, down = heights.shape[1] / size[0], heights.shape[0] / size[1]
    cut = (box[0] * across, box[1] * down, box[2] * across, box[3] * down)
    heights_image = Image.fromarray(np.maximum(heights, 0).astype(np.float32))
    return np.asarray(
        heights_image.resize((side, side), Image.Resampling.NEAREST, box=cut), np.float32
    )


def _vegetation(colour_HW3: FloatMap) -> tuple[FloatMap, FloatMap]:
    """(grass, trees), each (H, W) from 0 to 1: vegetation is green, trees darker than grass."""
    red, green, blue = (colour_HW3[..., c] for c in range(3))
    total = red + green + blue + 1
    plants = np.clip(((2 * green - red - blue) / total - 0.03) / 0.12, 0, 1)
    dark = np.clip((95 - total / 3) / 30, 0, 1)
    return (plants * (1 - dark)).astype(np.float32), (plants * dark * 0.8).astype(np.float32)
