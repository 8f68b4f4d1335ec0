"""How the bands of a mosaic become 8-bit RGB.

In: an open data set. Out: which bands, through which palette or stretch, and whether they are a
negative. Shapes: B bands, H x W pixels, N colours.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from rasterio.enums import ColorInterp, MaskFlags, Resampling
from rasterio.windows import Window as RasterWindow

from pipeline.core.arrays import Pixels
from pipeline.images.stretch import stretch_of

MAX_WHOLE_PIXELS = 4096
"A mosaic, or its coarsest overview, whose longer side has no more pixels is sampled as a whole."
SAMPLE_PIXELS = 1024  # longer side of that sample
PATCH_GRID, PATCH_PIXELS = 16, 64
"Longer mosaics: patches of 64 pixels, 16 by 16 of them evenly spread, at full resolution."
RGB = ("red", "green", "blue")


class UnknownColours(ValueError):
    """Bands that cannot be shown as RGB; the message says what was found and what was expected."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Colours:
    """How one mosaic is shown."""

    bands: tuple[int, ...]
    """Numbers, from 1, of the bands that are red, green and blue; of one band alone where it is
    grey or the index of a palette."""
    palette_N3: Pixels | None
    "RGB of each index."
    stretch: tuple[float, float] | None
    """Values that become 0 and 255, one pair for all bands, so that their proportions stay; None:
    8-bit as it is."""
    negative: bool
    "Whether the lowest value is white: photometric interpretation `white is zero`."
    gaps: bool
    """Whether there can be pixels without an image: the mosaic has nodata, alpha or a mask, or
    numbers that may be NaN."""
    one_mask: bool
    "Whether all bands share one mask."
    description: str
    "The same for a person, in a few words."


def colours_of(
    dataset: Any, stretch: tuple[float, float] | None, chosen: tuple[int, ...] | None = None
) -> Colours:
    """How a mosaic is to be shown.

    `stretch` is used where given, else found in a sample of the whole mosaic where one is needed.
    `chosen`: the bands to show, else those that the file names. Raises UnknownColours, and
    rasterio.errors.RasterioIOError.
    """
    interpretations, dtype = dataset.colorinterp, np.dtype(dataset.dtypes[0])
    bands, source = _bands(dataset, chosen)
    flags = [dataset.mask_flag_enums[band - 1] for band in bands]
    first = interpretations[bands[0] - 1]
    palette_N3 = _palette(dataset, bands[0]) if first == ColorInterp.palette else None
    structure = dataset.tags(ns="IMAGE_STRUCTURE")
    negative = palette_N3 is None and structure.get("MINISWHITE") == "YES"
    bits = int(dataset.tags(bands[0], ns="IMAGE_STRUCTURE").get("NBITS", 8 * dtype.itemsize))
    if palette_N3 is not None:
        stretch, description = None, "palette"
    elif stretch is None and dtype == np.uint8 and bits == 8:
        description = "uint8 as it is"
    else:
        if stretch is None:
            full = dtype == np.uint8  # of fewer bits
            stretch = (
                (0.0, 2.0**bits - 1)
                if full
                else stretch_of(np.concatenate(list(sample_values(dataset, bands))))
            )
        description = f"{dtype} stretched from {stretch[0]:.6g}..{stretch[1]:.6g}"
    if negative:
        description += ", white is zero"
    if len(interpretations) > 1:
        numbers = ", ".join(map(str, bands))
        plural = "s" if len(bands) > 1 else ""
        description += f", band{plural} {numbers} of {len(interpretations)}{source}"
    return Colours(
        bands=bands,
        palette_N3=palette_N3,
        stretch=stretch,
        negative=negative,
        gaps=np.issubdtype(dtype, np.floating)
        or any(MaskFlags.all_valid not in flag for flag in flags),
        one_mask=all(MaskFlags.per_dataset in flag for flag in flags),
        description=description,
    )


def _bands(dataset: Any, chosen: tuple[int, ...] | None) -> tuple[tuple[int, ...], str]:
    """The bands to show, and in words where that is known from.

    In this order: as chosen; as the bands' descriptions name them; as their colour interpretation
    does; the first three that are not alpha; the first one alone. Descriptions go before
    interpretations because somebody wrote them, whereas GDAL's default for a new file of three or
    four 8-bit bands is red, green, blue in this order.
    """
    interpretations = dataset.colorinterp
    if chosen is not None:
        if max(chosen) > len(interpretations):
            raise UnknownColours(
                f"{len(interpretations)} bands, expected band {max(chosen)} of --bands among them"
            )
        return chosen, " by --bands"
    named = [_colour_word(text or "") for text in dataset.descriptions]
    if all(named.count(colour) == 1 for colour in RGB):
        bands = tuple(named.index(colour) + 1 for colour in RGB)
        return bands, "" if bands == (1, 2, 3) else " by their names"
    interpreted = [kind.name for kind in interpretations]
    if all(colour in interpreted for colour in RGB):
        return tuple(interpreted.index(colour) + 1 for colour in RGB), ""
    shown = [at for at, kind in enumerate(interpretations, 1) if kind != ColorInterp.alpha] or [1]
    if len(shown) < 3:
        return (shown[0],), ""
    return tuple(shown[:3]), ", taken for red, green, blue as none is named: --bands takes others"


def _colour_word(description: str) -> str:
    """`red`, `green` or `blue` where a band's description has the word, and nothing else that is
    a colour (`red edge` and `near infrared` are none of them); else empty.
    """
    words = re.findall(r"[a-z]+", description.lower())
    if {"edge", "rededge", "infrared", "nir", "coastal"} & set(words):
        return ""
    colours = [word for word in words if word in RGB]
    return colours[0] if len(colours) == 1 else ""


def _palette(dataset: Any, band: int) -> Pixels:
    """(N, 3) RGB of every index that the band can hold; black where the file names none."""
    entries = dataset.colormap(band)
    palette_N3 = np.zeros((np.iinfo(dataset.dtypes[band - 1]).max + 1, 3), np.uint8)
    for index, colour in entries.items():
        palette_N3[index] = colour[:3]
    return palette_N3


def sample_values(dataset: Any, bands: tuple[int, ...]) -> Iterator[npt.NDArray[Any]]:
    """Valid values of bands, flat arrays: the mosaic thinned out, or patches of it where thinning
    would read all of it.
    """
    width, height = dataset.width, dataset.height
    coarsest = max(dataset.overviews(bands[0]), default=1)
    if max(width, height) <= MAX_WHOLE_PIXELS * coarsest:
        scale = min(1.0, SAMPLE_PIXELS / max(width, height))
        shape = (max(1, round(height * scale)), max(1, round(width * scale)))
        wanted = [(RasterWindow(0, 0, width, height), shape)]
    else:
        lefts, tops = (
            [
                round(step * max(0, length - PATCH_PIXELS) / (PATCH_GRID - 1))
                for step in range(PATCH_GRID)
            ]
            for length in (width, height)
        )
        shape = (min(PATCH_PIXELS, height), min(PATCH_PIXELS, width))
        wanted = [(RasterWindow(x, y, shape[1], shape[0]), shape) for y in tops for x in lefts]
    for window, shape in wanted:
        for band in bands:
            read = {"window": window, "out_shape": shape, "resampling": Resampling.nearest}
            values_HW, mask_HW = dataset.read(band, **read), dataset.read_masks(band, **read)
            yield values_HW[(mask_HW > 0) & np.isfinite(values_HW)].ravel()
