"""The paper's train and test transforms per view, on uint8. The network normalises.

Shapes: H x W pixels.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from PIL import Image

from pipeline.core.arrays import Pixels
from pipeline.core.records import View

Resizer = Literal["torch", "pillow"]
"""Whose antialiased bicubic. Torch's is several times as fast on a CPU with AVX2 and half as fast
on one without."""


def preprocessing_name(by: Resizer = "torch") -> str:
    """Part of the fingerprint: tables made with different preprocessing do not mix."""
    return f"resize bicubic {by}, ImageNet normalisation"


def resize(image_HW3: Pixels, size: int, by: Resizer = "torch") -> Pixels:
    """To (size, size, 3) by antialiased bicubic.

    Torch's is within one grey level of Pillow's, within two at a few pixels of the hardest edges.
    Both go along the rows first; Pillow from version 13 on goes down the columns first if an image
    is tall and shrinks, which shows at hard edges. One image by one thread: torch's code for AVX2
    starts no threads of its own, so many threads may call this.
    """
    height, width, _ = image_HW3.shape
    if height == width == size:
        return image_HW3
    if by == "pillow":
        bicubic = Image.Resampling.BICUBIC
        return np.asarray(Image.fromarray(image_HW3).resize((size, size), bicubic))
    # Here: packing and ranking, which resize nothing, would wait most of a second for it.
    import torch

    # A batch of one by reshape: with a new axis of stride 0 torch would not recognise channels
    # last, and rearrange the image.
    image_1HW3 = np.require(image_HW3, requirements=["C", "W"]).reshape(1, height, width, 3)
    image_13HW = torch.from_numpy(image_1HW3).permute(0, 3, 1, 2)
    resized_13HW = torch.nn.functional.interpolate(
        image_13HW, (size, size), mode="bicubic", antialias=True
    )
    resized_HW3: Pixels = resized_13HW.permute(0, 2, 3, 1)[0].numpy()
    return resized_HW3


@dataclass(frozen=True, kw_only=True)
class Augmentation:
    """The train transforms. The defaults are the paper's."""

    pad: int = 10
    """Pixels added on each side by repeating the edge; the image is cropped from the result
    [paper, LPN]."""
    rotation: float = 90.0
    "Satellite images are turned by a random angle within +- this many degrees [paper, LPN]."
    mirror: bool = True
    "Whether half of the images are mirrored [paper, LPN]."


def augment(
    image_HW3: Pixels,
    view: View,
    size: int,
    settings: Augmentation,
    rng: np.random.Generator,
    by: Resizer = "torch",
) -> Pixels:
    """Train transform of one image, (size, size, 3): resize, pad, turn (satellite only), crop,
    mirror.

    Turned corners are black and the nearest pixel is taken, as torchvision's RandomAffine does in
    LPN.
    """
    image_HW3 = resize(image_HW3, size, by)
    pad = settings.pad
    padded_HW3 = np.pad(image_HW3, ((pad, pad), (pad, pad), (0, 0)), mode="edge")
    if view == View.SATELLITE and settings.rotation:
        angle = float(rng.uniform(-settings.rotation, settings.rotation))
        turned = Image.fromarray(padded_HW3).rotate(angle, Image.Resampling.NEAREST)
        padded_HW3 = np.asarray(turned)
    top, left = rng.integers(0, 2 * pad, size=2, endpoint=True)
    cropped_HW3 = padded_HW3[top : top + size, left : left + size]
    if settings.mirror and rng.random() < 0.5:
        cropped_HW3 = cropped_HW3[:, ::-1]
    return np.ascontiguousarray(cropped_HW3)
