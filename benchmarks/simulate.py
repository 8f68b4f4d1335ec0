"""Images per second and core of the simulator, and their cost as a ratio to JPEG encoding alone.

World generation and JPEG encoding are included. Prints one line per image size; the ratio compares
CPU seconds per image with those that Pillow needs, in the same run, to encode the same images.

    python benchmarks/simulate.py [--sizes 64 128 256 512] [--views 54]

With `--sheet FILE` it writes a contact sheet instead: one location per row, first the satellite
image, then UAV images from the first to the last of the flight.
"""

import argparse
import io
import os
import time
from pathlib import Path

# One core is measured: NumPy reads these when it is imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from PIL import Image

from pipeline.simulation.location import JPEG_QUALITY, LocationSpec, render_location

LOCATIONS = {64: 4, 128: 4, 256: 3, 512: 1}
"Image size in pixels -> locations measured."


def measure(size: int, locations: int, views: int) -> tuple[float, float]:
    """(images per second of CPU time, its inverse over Pillow's JPEG encoding of the images)."""
    render_location(LocationSpec(seed=1, location=1, views=1, size=size))  # warm
    begin = time.process_time()
    made = [
        render_location(LocationSpec(seed=1, location=2 + number, views=views, size=size))
        for number in range(locations)
    ]
    seconds = time.process_time() - begin
    images = [
        Image.open(io.BytesIO(data)).convert("RGB")
        for location in made
        for data in (location.satellite, *location.drone)
    ]
    begin = time.process_time()
    for image in images:
        image.save(io.BytesIO(), "JPEG", quality=JPEG_QUALITY)
    return len(images) / seconds, seconds / (time.process_time() - begin)


def contact_sheet(
    path: Path, *, locations: list[int], views: int = 5, size: int = 160, seed: int = 0
) -> None:
    """Write a JPEG with a row per location."""
    rows = []
    for number in locations:
        spec = LocationSpec(seed=seed, location=number, views=views, size=size)
        location = render_location(spec)
        frames = (location.satellite, *location.drone)
        rows.append(np.hstack([np.asarray(Image.open(io.BytesIO(data))) for data in frames]))
    Image.fromarray(np.vstack(rows)).save(path, quality=78)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--sizes", type=int, nargs="+", choices=LOCATIONS, default=list(LOCATIONS), help="pixels")
    add("--views", type=int, default=54, help="UAV images per location")
    add("--sheet", type=Path, help="write a contact sheet of simulated towns to this JPEG")
    rows = [14, 11, 22, 13, 25, 12, 16]
    add("--locations", type=int, nargs="+", default=rows, help="the sheet's rows")
    args = parser.parse_args()
    if args.sheet:
        contact_sheet(args.sheet, locations=args.locations)
        return
    for size in args.sizes:
        rate, ratio = measure(size, LOCATIONS[size], args.views)
        print(
            f"simulate: {size} px, {rate:.1f} images/s per core, {ratio:.1f} x the time of "
            "encoding them as JPEG"
        )


if __name__ == "__main__":
    main()
