"""Pictures per second and core that the simulator makes, the making of the worlds and JPEG
included: a line per figure.

`python benchmarks/simulate.py` measures; with `--sheet FILE` it writes a contact sheet instead: one location a row, the
satellite's picture first, then the flight from its first view to its last.
"""

import argparse
import io
import os
import time
from pathlib import Path

# One core is measured: NumPy reads this when it is imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from PIL import Image

from pipeline.simulation.location import LocationSpec, render_location

VIEWS = 54


def measure(size: int, locations: int) -> float:
    """Pictures per second of CPU time, whole locations."""
    render_location(LocationSpec(seed=1, location=1, views=1, size=size))
    begin = time.process_time()
    for location in range(locations):
        render_location(LocationSpec(seed=1, location=2 + location, views=VIEWS, size=size))
    return locations * (VIEWS + 1) / (time.process_time() - begin)


def contact_sheet(
    path: Path, *, locations: list[int], views: int = 5, size: int = 160, seed: int = 0
) -> None:
    """Write a JPEG with a row per location."""
    rows = []
    for location in locations:
        taken = render_location(LocationSpec(seed=seed, location=location, views=views, size=size))
        rows.append(
            np.hstack(
                [
                    np.asarray(Image.open(io.BytesIO(data)))
                    for data in (taken.satellite, *taken.drone)
                ]
            )
        )
    Image.fromarray(np.vstack(rows)).save(path, quality=78)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--sheet", type=Path, help="write a contact sheet of made towns to this JPEG"
    )
    parser.add_argument(
        "--locations", type=int, nargs="+", default=[14, 11, 22, 13, 25, 12, 16], help="its rows"
    )
    asked = parser.parse_args()
    if asked.sheet:
        contact_sheet(asked.sheet, locations=asked.locations)
        return
    for size, locations in ((64, 4), (128, 4), (256, 3), (512, 1)):
        print(
            f"simulate: {measure(size, locations):.1f} images/s per core at {size} px, worlds and JPEG included"
        )


if __name__ == "__main__":
    main()
