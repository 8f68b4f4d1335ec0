"""AutoAugment's policy for ImageNet: two random operations an image, by a table of 25 rows.

In: an image (H, W, 3) and a generator. Out: an image of the same size. Operations are Pillow's, on
bytes.

Source: Cubuk et al. 2019 (arXiv 1805.09501), with the scales and the fill of the implementation
that MCCG trains with.
"""

from collections.abc import Callable
from typing import Literal

import numpy as np
from PIL import Image, ImageEnhance, ImageOps

from pipeline.core.arrays import Pixels

Operation = Literal[
    "posterize", "rotate", "solarize", "autocontrast", "equalize", "invert", "colour", "contrast",
    "sharpness", "shear_x",
]  # fmt: skip
Step = tuple[Operation, float, int]
"""Operation, its probability, and the index of its magnitude, 0 to 9. Where the operation has no
magnitude the index is 0."""

GREY = (128, 128, 128)
"What rotation and shear leave uncovered."
MAGNITUDES = 10
"Magnitudes of an operation; they are linear in their index."

FIRST_ROWS: tuple[tuple[Step, Step], ...] = (
    (("posterize", 0.4, 8), ("rotate", 0.6, 9)),
    (("solarize", 0.6, 5), ("autocontrast", 0.6, 0)),
    (("equalize", 0.8, 0), ("equalize", 0.6, 0)),
    (("posterize", 0.6, 7), ("posterize", 0.6, 6)),
    (("equalize", 0.4, 0), ("solarize", 0.2, 4)),
    (("equalize", 0.4, 0), ("rotate", 0.8, 8)),
    (("solarize", 0.6, 3), ("equalize", 0.6, 0)),
    (("posterize", 0.8, 5), ("equalize", 1.0, 0)),
    (("rotate", 0.2, 3), ("solarize", 0.6, 8)),
    (("equalize", 0.6, 0), ("posterize", 0.4, 6)),
    (("rotate", 0.8, 8), ("colour", 0.4, 0)),
    (("rotate", 0.4, 9), ("equalize", 0.6, 0)),
    (("equalize", 0.0, 0), ("equalize", 0.8, 0)),
    (("invert", 0.6, 0), ("equalize", 1.0, 0)),
    (("colour", 0.6, 4), ("contrast", 1.0, 8)),
    (("rotate", 0.8, 8), ("colour", 1.0, 2)),
    (("colour", 0.8, 8), ("solarize", 0.8, 7)),
    (("sharpness", 0.4, 7), ("invert", 0.6, 0)),
    (("shear_x", 0.6, 5), ("equalize", 1.0, 0)),
    (("colour", 0.4, 0), ("equalize", 0.6, 0)),
)
IMAGENET_POLICY = FIRST_ROWS + tuple(FIRST_ROWS[row - 1] for row in (5, 2, 14, 15, 3))
"The 25 rows; the last five are earlier ones again."


def auto_augment(image_HW3: Pixels, rng: np.random.Generator) -> Pixels:
    """The two operations of a random row of the policy, each by its probability."""
    image = Image.fromarray(np.ascontiguousarray(image_HW3))
    for operation, probability, index in IMAGENET_POLICY[rng.integers(len(IMAGENET_POLICY))]:
        sign = 1 if rng.random() < 0.5 else -1
        if rng.random() < probability:
            image = OPERATIONS[operation](image, index, sign)
    return np.array(image, np.uint8)


def magnitude(operation: Operation, index: int) -> float:
    """Degrees of `rotate`, bits of `posterize`, byte of `solarize`, share of the width of
    `shear_x`, and how far the factor of the others is from 1."""
    first, last = {
        "rotate": (0.0, 30.0),
        "shear_x": (0.0, 0.3),
        "posterize": (8.0, 4.0),
        "solarize": (256.0, 0.0),
    }.get(operation, (0.0, 0.9))
    value = first + (last - first) * index / (MAGNITUDES - 1)
    return round(value) if operation == "posterize" else value


def _posterize(image: Image.Image, index: int, _: int) -> Image.Image:
    """The upper bits of each byte are kept."""
    return ImageOps.posterize(image, int(magnitude("posterize", index)))


def _solarize(image: Image.Image, index: int, _: int) -> Image.Image:
    """Bytes from the threshold on are inverted."""
    threshold = magnitude("solarize", index)
    return image.point([value if value < threshold else 255 - value for value in range(256)] * 3)


def _rotate(image: Image.Image, index: int, _: int) -> Image.Image:
    """Counterclockwise only, as in the published implementation; the nearest pixel is taken."""
    return image.rotate(magnitude("rotate", index), fillcolor=GREY)


def _shear_x(image: Image.Image, index: int, sign: int) -> Image.Image:
    """Rows shift sideways in proportion to their number."""
    matrix = (1, sign * magnitude("shear_x", index), 0, 0, 1, 0)
    affine, bicubic = Image.Transform.AFFINE, Image.Resampling.BICUBIC
    return image.transform(image.size, affine, matrix, bicubic, fillcolor=GREY)


def _colour(image: Image.Image, index: int, sign: int) -> Image.Image:
    return ImageEnhance.Color(image).enhance(1 + sign * magnitude("colour", index))


def _contrast(image: Image.Image, index: int, sign: int) -> Image.Image:
    return ImageEnhance.Contrast(image).enhance(1 + sign * magnitude("contrast", index))


def _sharpness(image: Image.Image, index: int, sign: int) -> Image.Image:
    return ImageEnhance.Sharpness(image).enhance(1 + sign * magnitude("sharpness", index))


OPERATIONS: dict[Operation, Callable[[Image.Image, int, int], Image.Image]] = {
    "posterize": _posterize,
    "rotate": _rotate,
    "solarize": _solarize,
    "autocontrast": lambda image, _, __: ImageOps.autocontrast(image),
    "equalize": lambda image, _, __: ImageOps.equalize(image),
    "invert": lambda image, _, __: ImageOps.invert(image),
    "colour": _colour,
    "contrast": _contrast,
    "sharpness": _sharpness,
    "shear_x": _shear_x,
}
"Each takes an image, the index of its magnitude and a sign, +1 or -1."
