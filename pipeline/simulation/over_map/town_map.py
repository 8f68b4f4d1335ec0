"""A procedural town as a map that everyone can try: settings come in, GeoTIFFs go out.

    map.tif            the town from straight above on one day
    another_day.tif    the same ground on another day: other sun, shadows, season, haze
    surface.tif        heights of the same ground, metres
    town.json          the settings; written last

`fly.py --mosaic another_day.tif --surface surface.tif` takes photos of another day than the map's.
"""

from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.transform import Affine

from pipeline.core import json_files, storage
from pipeline.core.lock import locks_output
from pipeline.core.progress import console
from pipeline.simulation.appearance import Day, light_world, sample_day
from pipeline.simulation.over_map.settings import TownMapSettings
from pipeline.simulation.resume import begin, is_complete, local_root, settings_record
from pipeline.simulation.town.town import build_town
from pipeline.simulation.world import ByteMap, World

MAP, ANOTHER_DAY, SURFACE, TOWN_FILE = "map.tif", "another_day.tif", "surface.tif", "town.json"
CAMPUS_RADIUS_M = 40.0
CRS, EAST_M, NORTH_M = "EPSG:32632", 500_000.0, 5_150_000.0
"Upper left corner; nothing of the real place is used."


@locks_output(lambda settings: settings.out)
def make_town_map(settings: TownMapSettings) -> Path:
    """Write the town's maps; the folder. Does nothing where they are complete.

    Raises InputError for a folder that holds something else.
    """
    root = local_root(settings.out)
    about = settings_record(settings, ("out",))
    if is_complete(root, about, TOWN_FILE, "a town", "jobs/town.py"):
        console.print(f"{root} is complete already; nothing to do")
        return root
    begin(root, about)
    world, for_days = town_and_days(settings, 2)
    for name, rng in zip((MAP, ANOTHER_DAY), for_days, strict=True):
        write_day(world, rng, root / name)
    _write(root / SURFACE, world.height_HW[..., None], world.metres_per_pixel)
    json_files.write_checksummed(str(root / TOWN_FILE), about)
    storage.remove_folder(str(root / ".parts"))
    kilometres = settings.side / 1000
    console.print(f"{root}: a town of {kilometres:g} x {kilometres:g} km", markup=False)
    return root


def town_and_days(settings: TownMapSettings, count: int) -> tuple[World, list[np.random.Generator]]:
    """The town, and a generator for each of `count` days of it: the map's, another day's, and
    more."""
    for_town, *for_days = np.random.default_rng(settings.seed).spawn(1 + count)
    return build_town(for_town, CAMPUS_RADIUS_M, settings.side, settings.resolution), for_days


def write_day(world: World, rng: np.random.Generator, path: Path) -> None:
    """The world from straight above on a random day, as GeoTIFF."""
    _write(path, orthophoto(world, sample_day(rng), rng), world.metres_per_pixel)


def orthophoto(world: World, day: Day, rng: np.random.Generator) -> ByteMap:
    """The world (H, W, 3) from straight above everywhere, on one day, with a sensor's noise."""
    lit_HW3 = light_world(world, day).colour_HW3
    curve_3V = day.curve_3V()
    for channel in range(3):
        noise_HW = rng.standard_normal(lit_HW3.shape[:2], dtype=np.float32) * day.noise
        noisy_HW = np.clip(lit_HW3[..., channel] + noise_HW, 0, 255).astype(np.uint8)
        lit_HW3[..., channel] = curve_3V[channel][noisy_HW]
    return lit_HW3


def _write(path: Path, values_HWC: NDArray[np.generic], metres_per_pixel: float) -> None:
    """A tiled, compressed GeoTIFF, renamed to its name when it is whole."""
    height, width, count = values_HWC.shape
    colour: dict[str, object] = {"compress": "deflate", "predictor": 3}
    if count == 3:
        colour = {"compress": "jpeg", "jpeg_quality": 90, "photometric": "ycbcr"}
    part = path.with_name(f".{path.name}")
    with rasterio.open(
        part, "w", driver="GTiff", width=width, height=height, count=count,
        dtype=values_HWC.dtype.name, crs=CRS, tiled=True, blockxsize=256, blockysize=256,
        transform=Affine(metres_per_pixel, 0, EAST_M, 0, -metres_per_pixel, NORTH_M), **colour,
    ) as opened:  # fmt: skip
        opened.write(np.moveaxis(values_HWC, 2, 0))
    part.rename(path)
