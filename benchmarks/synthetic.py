"""Synthetic photos for the benchmarks: JPEGs whose detail resembles that of real photos."""

import io

import numpy as np
from PIL import Image

CELLS_AND_WEIGHTS = ((4, 0.45), (16, 0.3), (64, 0.15), (256, 0.1))
"Scales of the noise and their weights: the finer, the fainter."


def jpegs(count: int, width: int, height: int, seed: int = 0) -> list[bytes]:
    """JPEGs of noise at several scales; one of 512 x 512 px has some 60 kB."""
    rng = np.random.default_rng(seed)
    return [_jpeg(rng, width, height) for _ in range(count)]


def _jpeg(rng: np.random.Generator, width: int, height: int) -> bytes:
    image_HW3 = np.zeros((height, width, 3))
    for cells, weight in CELLS_AND_WEIGHTS:
        coarse = Image.fromarray(rng.integers(0, 256, (cells, cells, 3), np.uint8))
        resized = coarse.resize((width, height), Image.Resampling.BICUBIC)
        image_HW3 += weight * np.asarray(resized)
    buffer = io.BytesIO()
    Image.fromarray(image_HW3.astype(np.uint8)).save(buffer, "JPEG", quality=90)
    return buffer.getvalue()
