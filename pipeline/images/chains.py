"""The steps that other methods augment with, and their order: Sample4Geo's chain, and MCCG's.

In: an image (H, W, 3), uint8, and a generator. Out: such an image, of the network's size after
`sample4geo_chain`, of its own after any other step. Each step is a pure function of the generator.
The defaults of the steps are those of albumentations 1.3.1, which Sample4Geo, DAC, CAMP and QDFL
use. Shapes: H x W pixels, K x K taps of a kernel.
"""

from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Doubles, Pixels
from pipeline.core.records import View
from pipeline.images.auto_augment import auto_augment

MEAN_COLOUR = (124, 116, 104)
"ImageNet's mean colour in bytes: 0 after the network's normalisation."
FULL_HUE = 180
"OpenCV's hue of a byte image has two degrees a step."


@dataclass(frozen=True, kw_only=True)
class JitterRanges:
    """Factors are drawn from 1 - x to 1 + x, the hue's shift from -x to x of its circle."""

    brightness: float
    contrast: float
    saturation: float
    hue: float


SAMPLE4GEO = JitterRanges(brightness=0.15, contrast=0.15, saturation=0.15, hue=0.15)
DAC_SATELLITE = JitterRanges(brightness=0.15, contrast=0.3, saturation=0.3, hue=0.3)
DAC_DRONE = JitterRanges(brightness=0.15, contrast=0.7, saturation=0.3, hue=0.3)
MCCG = JitterRanges(brightness=0.1, contrast=0.1, saturation=0.1, hue=0.0)


def sample4geo_chain(
    image_HW3: Pixels, view: View, size: int, wide: bool, rng: np.random.Generator
) -> Pixels:
    """Train transform of Sample4Geo, (size, size, 3); with the wide colour jitter that of DAC, CAMP
    and QDFL. The images of a pair are mirrored before it, outside.
    """
    ranges = SAMPLE4GEO
    if wide:
        ranges = DAC_DRONE if view == View.DRONE else DAC_SATELLITE
    if rng.random() < 0.5:
        image_HW3 = compress(image_HW3, int(rng.integers(90, 100, endpoint=True)))
    image_HW3 = resize_bilinear(image_HW3, size)
    if rng.random() < 0.5:
        image_HW3 = jitter_colours(image_HW3, ranges, rng)
    if rng.random() < 0.3:
        change_focus = blur_anisotropically if rng.random() < 0.5 else sharpen
        image_HW3 = change_focus(image_HW3, rng)
    if rng.random() < 0.3:
        image_HW3 = drop_grid(image_HW3) if rng.random() < 0.5 else drop_rectangles(image_HW3, rng)
    if view == View.SATELLITE:
        image_HW3 = np.rot90(image_HW3, int(rng.integers(4)))
    return np.ascontiguousarray(image_HW3)


def mccg_colours(image_HW3: Pixels, view: View, rng: np.random.Generator) -> Pixels:
    """What MCCG does before LPN's transforms: AutoAugment of UAV images, and a colour jitter."""
    if view == View.DRONE:
        image_HW3 = auto_augment(image_HW3, rng)
    return jitter_colours(image_HW3, MCCG, rng)


def compress(image_HW3: Pixels, quality: int) -> Pixels:
    """The image as JPEG of this quality, 0 to 100, shows it."""
    import simplejpeg

    data = simplejpeg.encode_jpeg(np.ascontiguousarray(image_HW3), quality, colorsubsampling="420")
    decoded_HW3: Pixels = simplejpeg.decode_jpeg(data)
    return decoded_HW3


def resize_bilinear(image_HW3: Pixels, size: int) -> Pixels:
    """To (size, size, 3), bilinear without antialiasing."""
    import cv2

    image_HW3 = np.ascontiguousarray(image_HW3)
    return np.asarray(cv2.resize(image_HW3, (size, size), interpolation=cv2.INTER_LINEAR_EXACT))


def jitter_colours(image_HW3: Pixels, ranges: JitterRanges, rng: np.random.Generator) -> Pixels:
    """Brightness, contrast, saturation and hue by random amounts, in random order."""
    most = (ranges.brightness, ranges.contrast, ranges.saturation, ranges.hue)
    brightness, contrast, saturation = (1 + rng.uniform(-x, x) for x in most[:3])
    turn = float(rng.uniform(-ranges.hue, ranges.hue))
    for step in rng.permutation(4):
        match int(step):
            case 0:
                image_HW3 = _mix(image_HW3, 0.0, brightness)
            case 1:
                image_HW3 = _mix(image_HW3, _grey(image_HW3).mean(), contrast)
            case 2:
                image_HW3 = _mix(image_HW3, _grey(image_HW3)[..., None], saturation)
            case _:
                image_HW3 = shift_hue(image_HW3, turn)
    return image_HW3


def shift_hue(image_HW3: Pixels, turn: float) -> Pixels:
    """Hues shifted by `turn` of the colour circle: 1/3 makes red green."""
    import cv2

    if round(turn * FULL_HUE) == 0:
        return image_HW3
    hsv_HW3 = cv2.cvtColor(np.ascontiguousarray(image_HW3), cv2.COLOR_RGB2HSV)
    hues_HW = hsv_HW3[..., 0].astype(np.int16) + round(turn * FULL_HUE)
    hsv_HW3[..., 0] = hues_HW % FULL_HUE
    return np.asarray(cv2.cvtColor(hsv_HW3, cv2.COLOR_HSV2RGB), np.uint8)


def _grey(image_HW3: Pixels) -> Pixels:
    import cv2

    return np.asarray(cv2.cvtColor(np.ascontiguousarray(image_HW3), cv2.COLOR_RGB2GRAY), np.uint8)


def _mix(image_HW3: Pixels, base: Pixels | float, factor: float) -> Pixels:
    """base + factor (image - base), in bytes."""
    values_HW3 = np.float32(factor) * image_HW3 + np.float32(1 - factor) * np.float32(base)
    mixed_HW3: Pixels = np.clip(values_HW3 + 0.5, 0, 255).astype(np.uint8)
    return mixed_HW3


def blur_anisotropically(image_HW3: Pixels, rng: np.random.Generator) -> Pixels:
    """A blur by a noisy generalised Gaussian, wider along one direction."""
    width = int(rng.choice((3, 5, 7)))
    sigma_x, sigma_y = rng.uniform(0.2, 1, 2)
    angle = float(np.radians(rng.uniform(-90, 90)))
    # Half each, or the narrow kernels of beta > 1 would be most of them.
    beta = float(rng.uniform(0.5, 1) if rng.random() < 0.5 else rng.uniform(1, 8))
    kernel_KK = gaussian_kernel(width, sigma_x, sigma_y, angle, beta)
    kernel_KK = kernel_KK * rng.uniform(0.9, 1.1, kernel_KK.shape)
    return _convolve(image_HW3, kernel_KK / kernel_KK.sum())


def gaussian_kernel(
    width: int, sigma_x: float, sigma_y: float, angle: float, beta: float
) -> Doubles:
    """exp(-(r^T S^-1 r)^beta / 2) on (width, width) taps, not normalised. S is diag(sigma_x^2,
    sigma_y^2) in pixels, turned by `angle` radians; beta 1 is a Gaussian."""
    steps = np.arange(width) - (width - 1) / 2
    x_KK, y_KK = np.meshgrid(steps, steps)
    along_KK = (np.cos(angle) * x_KK + np.sin(angle) * y_KK) / sigma_x
    across_KK = (np.cos(angle) * y_KK - np.sin(angle) * x_KK) / sigma_y
    kernel_KK: Doubles = np.exp(-0.5 * (along_KK**2 + across_KK**2) ** beta)
    return kernel_KK


def sharpen(image_HW3: Pixels, rng: np.random.Generator) -> Pixels:
    """The image mixed with its sharpened version."""
    return _convolve(image_HW3, sharpening_kernel(rng.uniform(0.2, 0.5), rng.uniform(0.5, 1)))


def sharpening_kernel(share: float, lightness: float) -> Doubles:
    """(1 - share) identity + share [all -1, centre 8 + lightness]; the taps' sum is 1 - share +
    share * lightness, so the result is darker unless lightness is 1."""
    kernel_33 = np.full((3, 3), -share)
    kernel_33[1, 1] = (1 - share) + share * (8 + lightness)
    return kernel_33


def _convolve(image_HW3: Pixels, kernel_KK: Doubles) -> Pixels:
    import cv2

    return np.asarray(cv2.filter2D(np.ascontiguousarray(image_HW3), -1, kernel_KK), np.uint8)


def drop_grid(image_HW3: Pixels) -> Pixels:
    """Black squares on a fixed grid: cells are a tenth of a side, the upper left 0.4 of each is
    black."""
    height, width, _ = image_HW3.shape
    rows, columns = (
        np.arange(side) % (cell := max(2, side // 10)) < max(1, int(0.4 * cell))
        for side in (height, width)
    )
    dropped_HW3 = image_HW3.copy()
    dropped_HW3[np.ix_(rows, columns)] = 0
    return dropped_HW3


def drop_rectangles(image_HW3: Pixels, rng: np.random.Generator) -> Pixels:
    """10 to 25 black rectangles with sides of 10 to 20 % of the image's."""
    dropped_HW3 = image_HW3.copy()
    for _ in range(int(rng.integers(10, 25, endpoint=True))):
        spans = []
        for side in image_HW3.shape[:2]:
            fewest, most = max(1, int(0.1 * side)), max(1, int(0.2 * side))
            length = int(rng.integers(fewest, most, endpoint=True))
            start = int(rng.integers(0, side - length, endpoint=True))
            spans.append(slice(start, start + length))
        dropped_HW3[tuple(spans)] = 0
    return dropped_HW3


def erase(image_HW3: Pixels, rng: np.random.Generator) -> Pixels:
    """A rectangle in ImageNet's mean colour, of 2 to 40 % of the area and with height / width from
    0.3 to 1 / 0.3 [Zhong 2017, arXiv 1708.04896]. Rectangles that do not fit are drawn anew, at
    most 100 times."""
    height, width, _ = image_HW3.shape
    for _ in range(100):
        area = rng.uniform(0.02, 0.4) * height * width
        aspect = rng.uniform(0.3, 1 / 0.3)
        rows, columns = round(np.sqrt(area * aspect)), round(np.sqrt(area / aspect))
        if 0 < rows < height and 0 < columns < width:
            top = int(rng.integers(0, height - rows, endpoint=True))
            left = int(rng.integers(0, width - columns, endpoint=True))
            erased_HW3 = image_HW3.copy()
            erased_HW3[top : top + rows, left : left + columns] = MEAN_COLOUR
            return erased_HW3
    return image_HW3
