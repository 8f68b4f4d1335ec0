"""Whether the sun of a map is found, and how near another day's light on it comes to that day.

    python benchmarks/relight.py [--towns 6] [--side 300] [--resolution 0.5]

Each town is photographed from above on two days of known suns. From the first picture and the
heights its sun is found, its light is taken away, and the second day's falls on the same ground.
Prints the sun's errors, and how much of the second day's true picture stays unexplained (1 - the
correlation of brightness), as a ratio to the same with the first day's light kept, as photos are
simulated over maps without heights.
"""

import argparse
import time

import numpy as np

from pipeline.core.arrays import Floats, Pixels
from pipeline.simulation.appearance import Day, sample_day
from pipeline.simulation.over_map.town_map import CAMPUS_RADIUS_M, orthophoto
from pipeline.simulation.relight import find_day
from pipeline.simulation.texture import photographed_world
from pipeline.simulation.town.town import build_town
from pipeline.simulation.world import World


def brightness(picture_HW3: Pixels) -> Floats:
    return np.asarray(picture_HW3.mean(axis=2), np.float32).ravel()


def unexplained(picture_HW3: Pixels, truth_HW3: Pixels) -> float:
    """1 - the correlation of brightness."""
    return 1 - float(np.corrcoef(brightness(picture_HW3), brightness(truth_HW3))[0, 1])


def on_another_day(map_HW3: Pixels, ground: World, light: Day | None, day: Day) -> Pixels:
    """The map's ground on `day`, its own light taken away where that is known."""
    photographed = photographed_world(
        map_HW3, ground.height_HW, metres_per_pixel=ground.metres_per_pixel,
        target_radius_m=ground.target_radius_m, day=light,
    )  # fmt: skip
    return orthophoto(photographed, day, np.random.default_rng(0))


def turn_between(some_deg: float, other_deg: float) -> float:
    return abs((some_deg - other_deg + 180) % 360 - 180)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--towns", type=int, default=6)
    parser.add_argument("--side", type=float, default=300.0, help="of a town, metres")
    parser.add_argument("--resolution", type=float, default=0.5, help="metres a pixel")
    options = parser.parse_args()
    print(
        "| town | sun's azimuth off | elevation off | found in | unexplained, light kept | relit |"
    )
    print("|---|---|---|---|---|---|")
    ratios, found = [], 0
    for town in range(options.towns):
        for_town, *days_rng = np.random.default_rng(town).spawn(3)
        world = build_town(for_town, CAMPUS_RADIUS_M, options.side, options.resolution)
        first, second = (sample_day(rng) for rng in days_rng)
        map_HW3, truth_HW3 = (
            orthophoto(world, day, rng) for day, rng in zip((first, second), days_rng, strict=True)
        )
        begin = time.perf_counter()
        day = find_day(map_HW3, world.height_HW, world.metres_per_pixel)
        seconds = time.perf_counter() - begin

        kept, relit = (
            unexplained(on_another_day(map_HW3, world, light, second), truth_HW3)
            for light in (None, day)
        )
        ratios.append(relit / kept)
        if day is None:
            print(f"| {town} | no sun found | | {seconds:.2f} s | {kept:.3f} | {relit:.3f} |")
            continue
        found += 1
        print(
            f"| {town} | {turn_between(day.sun_azimuth_deg, first.sun_azimuth_deg):.1f} "
            f"| {abs(day.sun_elevation_deg - first.sun_elevation_deg):.1f} | {seconds:.2f} s "
            f"| {kept:.3f} | {relit:.3f} |"
        )
    print(
        f"the sun was found of {found} of {options.towns} maps; unexplained of another day: "
        f"{np.median(ratios):.2f} x that with the map's own light (median)"
    )


if __name__ == "__main__":
    main()
