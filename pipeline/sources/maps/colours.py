"""How a mosaic's bands become 8-bit RGB. In: an open data set. Out: which bands, through which
palette or stretch.

Shapes: B bands, H x W pixels, N colours.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from rasterio.enums import ColorInterp, MaskFlags, Resampling
from rasterio.windows import Window as RasterWindow

from pipeline.images.decode import Pixels

PERCENTILES = (2.0, 98.0)  # of the whole mosaic: what a stretch shows from black to white
MAX_WHOLE_PIXELS = (
    4096  # pixels: a mosaic, or its coarsest overview, no longer than this is sampled as a whole
)
SAMPLE_PIXELS = 1024  # pixels: longer side of that sample
PATCH_GRID, PATCH_PIXELS = (
    16,
    64,
)  # else: patches of 64 pixels, 16 by 16 of them evenly spread, at full resolution


@dataclass(frozen=True, kw_only=True, eq=False)
class Colours:
    """How one mosaic is shown."""

    bands: tuple[int, ...]
    """Numbers, from 1, of the bands that are red, green and blue; of one alone where it is grey or
    a palette's index."""
    palette_N3: Pixels | None
    "RGB of each index."
    stretch: tuple[float, float] | None
    """Values that become 0 and 255, one pair for all bands, so that their proportions stay; None:
    8-bit as they are."""
    gaps: bool
    """Whether it can hold pixels without an image: it has nodata, alpha or a mask, or numbers that
    may be NaN."""
    one_mask: bool
    "Whether one mask is there for all bands."
    said: str
    "The same for a person, in a few words."


def colours_of(dataset: Any, stretch: tuple[float, float] | None) -> Colours:
    """How a mosaic is to be shown; `stretch` is taken where given, else found in a sample of the
    whole where needed.

    Raises rasterio.errors.RasterioIOError.
    """
    kinds, dtype = dataset.colorinterp, np.dtype(dataset.dtypes[0])
    bands = _bands(kinds)
    flags = [dataset.mask_flag_enums[band - 1] for band in bands]
    one_mask = all(MaskFlags.per_dataset in flag for flag in flags)
    gaps = np.issubdtype(dtype, np.floating) or any(
        MaskFlags.all_valid not in flag for flag in flags
    )
    palette_N3 = _palette(dataset, bands[0]) if kinds[bands[0] - 1] == ColorInterp.palette else None
    if palette_N3 is not None:
        stretch, said = None, "palette"
    elif stretch is None and dtype == np.uint8:
        said = "uint8 as it is"
    else:
        stretch = stretch or _percentiles(dataset, bands)
        said = f"{dtype} stretched from {stretch[0]:.6g}..{stretch[1]:.6g}"
    if len(kinds) > 1:
        said += (
            f", band{'s' if len(bands) > 1 else ''} {', '.join(map(str, bands))} of {len(kinds)}"
        )
    return Colours(
        bands=bands, palette_N3=palette_N3, stretch=stretch, gaps=gaps, one_mask=one_mask, said=said
    )


def to_8bit(values_BHW: npt.NDArray[Any], stretch: tuple[float, float] | None) -> Pixels:
    """Values between the two of `stretch` linearly to 0..255, beyond them cut off; what is no
    number is 0.
    """
    if stretch is None:
        return values_BHW.astype(np.uint8, copy=False)
    low, high = stretch
    values_BHW = np.where(np.isfinite(values_BHW), values_BHW, low)
    return np.rint(np.clip((values_BHW - low) * (255 / (high - low)), 0, 255)).astype(np.uint8)


def _bands(kinds: tuple[ColorInterp, ...]) -> tuple[int, ...]:
    """Red, green, blue as the file names them; else the first three that are not alpha; else the
    first alone.
    """
    named = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
    if all(kind in kinds for kind in named):
        return tuple(kinds.index(kind) + 1 for kind in named)
    shown = [number for number, kind in enumerate(kinds, start=1) if kind != ColorInterp.alpha] or [
        1
    ]
    return tuple(shown[:3]) if len(shown) >= 3 else (shown[0],)


def _palette(dataset: Any, band: int) -> Pixels:
    """(N, 3) RGB of every index that the band can hold; black where the file names none."""
    entries = dataset.colormap(band)
    palette_N3 = np.zeros((np.iinfo(dataset.dtypes[band - 1]).max + 1, 3), np.uint8)
    for index, colour in entries.items():
        palette_N3[index] = colour[:3]
    return palette_N3


def _percentiles(dataset: Any, bands: tuple[int, ...]) -> tuple[float, float]:
    """The stretch of a mosaic without one; wide enough to divide by, and 0..1 where it is all
    nodata.
    """
    values = np.concatenate(list(sample_values(dataset, bands)))
    if not len(values):
        return 0.0, 1.0
    low, high = (float(value) for value in np.percentile(values, PERCENTILES))
    return low, max(
        high, low + 1 if values.dtype.kind in "iu" else np.nextafter(low, np.inf) + 1e-9
    )


def sample_values(dataset: Any, bands: tuple[int, ...]) -> Iterator[npt.NDArray[Any]]:
    """Valid values of bands, flat arrays: the mosaic thinned out, or patches of it where that would
    read it all.
    """
    width, height = dataset.width, dataset.height
    coarsest = max(dataset.overviews(bands[0]), default=1)
    if max(width, height) <= MAX_WHOLE_PIXELS * coarsest:
        scale = min(1.0, SAMPLE_PIXELS / max(width, height))
        wanted = [
            (
                RasterWindow(0, 0, width, height),
                (max(1, round(height * scale)), max(1, round(width * scale))),
            )
        ]
    else:
        lefts, tops = (
            [
                round(spot * max(0, length - PATCH_PIXELS) / (PATCH_GRID - 1))
                for spot in range(PATCH_GRID)
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
