"""The train transforms per view, on uint8: the paper's geometry, or an affine one, and the looks of
other sensors and days; or the chain of another method. The network normalises.

In: a decoded image. Out: (size, size, 3). Shapes: H x W pixels.
"""

from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
import numpy.typing as npt
from PIL import Image

from pipeline.core.arrays import Pixels
from pipeline.core.errors import InputError, require
from pipeline.core.records import View
from pipeline.images.chains import compress, erase, mccg_colours, sample4geo_chain
from pipeline.images.transforms import Resizer, resize

Chain = Literal["own", "sample4geo", "dac", "mccg"]
"""`own`: what the other settings say. `sample4geo`: that method's steps in place of them, resized
bilinearly; `dac`: the same with the wider colour jitter of DAC, CAMP and QDFL. `mccg`: AutoAugment
(UAV images only) and a colour jitter before the other settings' steps, a rectangle erased from half
of the UAV images after them."""

LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)
"Weights of red, green and blue in a pixel's grey (ITU-R BT.601)."
MCCG_ERASED = 0.5
"Share of the UAV images that MCCG erases a rectangle of."


@dataclass(frozen=True, kw_only=True)
class Augmentation:
    """The train transforms. The defaults are the paper's."""

    pad: int = 10
    """Pixels added on each side by repeating the edge; the image is cropped from the result
    [paper, LPN]. Not with `affine`."""
    rotation: float = 90.0
    "Satellite images are turned by a random angle within +- this many degrees [paper, LPN]."
    mirror: bool = True
    "Whether half of the images are mirrored [paper, LPN]."
    affine: bool = False
    """Turn, scale and shift in one step, interpolated, over mirrored edges; the paper's way takes
    the nearest pixel and leaves black corners in one view only [chosen]."""
    drone_rotation: float = 0.0
    "UAV images likewise, with `affine`: a camera's roll [chosen: none]."
    scale: float = 0.0
    "Images are scaled by a random factor between 1 / (1 + scale) and 1 + scale, with `affine`."
    shift: float = 0.0
    "And shifted by up to this share of their side along each axis, with `affine`."
    colour: float = 0.0
    "Strength of random brightness, contrast, colour balance, saturation and haze; 1 is strong."
    blur: float = 0.0
    "Largest standard deviation of a Gaussian blur, in pixels of the network's input."
    noise: float = 0.0
    "Largest standard deviation of the sensor's noise, in byte values."
    jpeg: float = 0.0
    "Share of the images that are compressed again, as JPEG of quality 20 to 90."
    hide: float = 0.0
    "Share of the images of which a rectangle is covered."
    chain: Chain = "own"
    """Whose steps the images go through: those of the other settings (own), another method's in
    place of them (sample4geo, dac), or around them (mccg) [paper: own]."""
    pair_mirror: bool = False
    """Whether half of the pairs are mirrored, both images together, before all other steps; only
    with a sampler of pairs [Sample4Geo, DAC, CAMP: yes; QDFL: no]."""
    erase: float = 0.0
    """Share of the images of which a rectangle is erased: ImageNet's mean colour, after all other
    steps [chosen: none; LCM: 0.5]."""

    def __post_init__(self) -> None:
        for name in ("jpeg", "hide", "erase"):
            require(0 <= getattr(self, name) <= 1, name, getattr(self, name), "0 to 1")
        for name in ("pad", "scale", "shift", "colour", "blur", "noise"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "0 or more")
        moves = self.drone_rotation or self.scale or self.shift
        if moves and not self.affine:
            raise InputError(
                "found one of --drone-rotation, --scale and --shift, expected --affine too, "
                "without which they have no effect"
            )
        if self.chain == "mccg" and self.erase:
            raise InputError(
                "found --erase with --chain mccg, which erases half of the UAV images itself, "
                "expected one of the two"
            )
        if self.chain in ("sample4geo", "dac"):
            self._require_own_steps_unchanged()

    def _require_own_steps_unchanged(self) -> None:
        for setting in fields(self):
            value, default = getattr(self, setting.name), setting.default
            if setting.name not in ("chain", "pair_mirror", "erase") and value not in (0, default):
                flag = setting.name.replace("_", "-")
                raise InputError(
                    f"found --{flag} {value} with --chain {self.chain}, where it has no effect, "
                    f"expected its default {default}; leave it out, or take --chain own"
                )


def augment(
    image_HW3: Pixels,
    view: View,
    size: int,
    settings: Augmentation,
    rng: np.random.Generator,
    by: Resizer = "torch",
) -> Pixels:
    """Train transform of one image, (size, size, 3): geometry, mirror, then the sensor's look; or
    the steps of another method's chain.

    `by` resizes, except in the chains `sample4geo` and `dac`.
    """
    share = settings.erase
    if settings.chain in ("sample4geo", "dac"):
        image_HW3 = sample4geo_chain(image_HW3, view, size, settings.chain == "dac", rng)
    else:
        if settings.chain == "mccg":
            image_HW3 = mccg_colours(image_HW3, view, rng)
            share = MCCG_ERASED if view == View.DRONE else 0.0
        image_HW3 = _augment_as_set(image_HW3, view, size, settings, rng, by)
    if share and rng.random() < share:
        image_HW3 = erase(image_HW3, rng)
    return image_HW3


def _augment_as_set(
    image_HW3: Pixels,
    view: View,
    size: int,
    settings: Augmentation,
    rng: np.random.Generator,
    by: Resizer,
) -> Pixels:
    image_HW3 = resize(image_HW3, size, by)
    move = _move_affinely if settings.affine else _move_as_published
    moved_HW3 = move(image_HW3, view, settings, rng)
    if settings.mirror and rng.random() < 0.5:
        moved_HW3 = moved_HW3[:, ::-1]
    return np.ascontiguousarray(change_look(moved_HW3, settings, rng))


def _move_as_published(
    image_HW3: Pixels, view: View, settings: Augmentation, rng: np.random.Generator
) -> Pixels:
    """Pad, turn (satellite only) and crop. Turned corners are black and the nearest pixel is taken,
    as torchvision's RandomAffine does in LPN.
    """
    import cv2

    size, pad = len(image_HW3), settings.pad
    padded_HW3 = cv2.copyMakeBorder(image_HW3, pad, pad, pad, pad, cv2.BORDER_REPLICATE)
    if view == View.SATELLITE and settings.rotation:
        angle = float(rng.uniform(-settings.rotation, settings.rotation))
        turned = Image.fromarray(padded_HW3).rotate(angle, Image.Resampling.NEAREST)
        padded_HW3 = np.asarray(turned)
    top, left = rng.integers(0, 2 * pad, size=2, endpoint=True)
    return np.asarray(padded_HW3[top : top + size, left : left + size], np.uint8)


def _move_affinely(
    image_HW3: Pixels, view: View, settings: Augmentation, rng: np.random.Generator
) -> Pixels:
    """Turn, scale and shift by one affine map; beyond the edge lies the mirror image."""
    import cv2

    size = len(image_HW3)
    most = settings.rotation if view == View.SATELLITE else settings.drone_rotation
    angle = float(rng.uniform(-most, most))
    factor = float(np.exp(rng.uniform(-1, 1) * np.log1p(settings.scale)))
    middle = (size - 1) / 2
    matrix_23 = np.asarray(cv2.getRotationMatrix2D((middle, middle), angle, factor), np.float64)
    matrix_23[:, 2] += rng.uniform(-1, 1, 2) * settings.shift * size
    moved_HW3 = cv2.warpAffine(
        image_HW3,
        matrix_23,
        (size, size),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT_101,
    )
    return np.asarray(moved_HW3, np.uint8)


def change_look(image_HW3: Pixels, settings: Augmentation, rng: np.random.Generator) -> Pixels:
    """Another sensor, air and day: blur, colours, noise, a covered rectangle, compression."""
    if settings.blur:
        image_HW3 = _blur(image_HW3, float(rng.uniform(0, settings.blur)))
    if settings.colour or settings.noise:
        values_HW3 = change_colours(image_HW3.astype(np.float32), settings.colour, rng)
        if settings.noise:
            spread = np.float32(rng.uniform(0, settings.noise))
            values_HW3 += spread * rng.standard_normal(values_HW3.shape, np.float32)
        image_HW3 = np.clip(values_HW3 + 0.5, 0, 255).astype(np.uint8)
    if settings.hide and rng.random() < settings.hide:
        image_HW3 = _hide(image_HW3, rng)
    if settings.jpeg and rng.random() < settings.jpeg:
        image_HW3 = compress(image_HW3, int(rng.integers(20, 90)))
    return image_HW3


def change_colours(
    values_HW3: npt.NDArray[np.float32], strength: float, rng: np.random.Generator
) -> npt.NDArray[np.float32]:
    """Byte values (H, W, 3), not clipped, with random brightness, contrast, colour balance,
    saturation and haze; unchanged at strength 0.
    """
    brightness, contrast, saturation = np.exp(strength * rng.uniform(-0.4, 0.4, 3)).astype("f4")
    balance_3 = np.exp(strength * rng.uniform(-0.15, 0.15, 3)).astype(np.float32)
    haze, air = np.float32(strength * rng.uniform(0, 0.3)), np.float32(rng.uniform(170, 230))
    grey_HW1 = (values_HW3 @ LUMINANCE)[..., None]
    values_HW3 = grey_HW1 + saturation * (values_HW3 - grey_HW1)
    mean = grey_HW1.mean()
    values_HW3 = (mean + contrast * (values_HW3 - mean)) * (brightness * balance_3)
    return (1 - haze) * values_HW3 + haze * air if strength else values_HW3


def _blur(image_HW3: Pixels, sigma: float) -> Pixels:
    import cv2

    if sigma < 0.1:
        return image_HW3
    return np.asarray(cv2.GaussianBlur(image_HW3, (0, 0), sigma), np.uint8)


def _hide(image_HW3: Pixels, rng: np.random.Generator) -> Pixels:
    """A rectangle, a sixth to a half of the side long and wide, in one colour."""
    size = len(image_HW3)
    height, width = (int(size * rng.uniform(1 / 6, 1 / 2)) for _ in range(2))
    top, left = int(rng.integers(0, size - height)), int(rng.integers(0, size - width))
    hidden_HW3 = image_HW3.copy()
    hidden_HW3[top : top + height, left : left + width] = rng.integers(0, 256, 3, np.uint8)
    return hidden_HW3
