"""How near what a region promises comes to what is seen, on several days.

    python benchmarks/promise.py --out DIR [--days 4] [--photos 100] [--tags "with tags" without]

DIR is the folder of `region.py` over a town, adapted. The town is photographed from above on as
many other days (sun, season, haze, sensor), photos over each are located by the region, and the
share within 5 and 25 m of each day stands beside what the region's page says. One day's share
differs from another's by more than the chance of its photos: the promise is compared with the mean
over the days, whose standard error is that of days.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from region import TAGS, locate_all, take_photos

from jobs.encoding.localizer import with_localizer
from jobs.stages.settings import LocateSettings
from pipeline.core import cluster, json_files
from pipeline.region.expectation import WITHIN_M, expect, read_expectations
from pipeline.simulation.over_map.settings import TownMapSettings
from pipeline.simulation.over_map.town_map import (
    SURFACE,
    TOWN_FILE,
    town_and_days,
    write_day,
)


def other_days(town: Path, count: int) -> list[Path]:
    """Maps of so many days that are not the map's; made where they are missing."""
    known = json_files.read_checksummed(str(town / TOWN_FILE))
    world, [_, *days] = town_and_days(TownMapSettings(out=str(town), **known), 1 + count)
    paths = [town / f"day-{number}.tif" for number in range(1, count + 1)]
    for path, rng in zip(paths, days, strict=True):
        if not path.exists():
            write_day(world, rng, path)
    return paths


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="of region.py")
    parser.add_argument("--days", type=int, default=4)
    parser.add_argument("--photos", type=int, default=100, help="of each day")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--height", type=float, nargs=2, default=(60.0, 120.0), help="metres")
    parser.add_argument("--pitch", type=float, nargs=2, default=(-90.0, -45.0), help="degrees")
    parser.add_argument("--tags", nargs="+", default=list(TAGS), choices=TAGS)
    options = parser.parse_args()
    out: Path = options.out
    cluster.connect()
    region, town = out / "region", out / "map"
    figures = json.loads((region / "expect" / "figures.json").read_text())
    promised = dict(zip(TAGS, read_expectations(figures["expectations"]), strict=False))
    print("| photos | within 5 m | within 25 m | within 25 m, x the promise |")
    print("|---|---|---|---|")
    for tags in options.tags:
        page = promised[tags]
        spans = [f"{one.value:.1%} [{one.low:.1%}, {one.high:.1%}]" for one in page.within[1:]]
        print(f"| promised, {tags}, {page.photos} checks | {' | '.join(spans)} | 1.00 x |")
    seen: dict[str, list[list[float]]] = {tags: [] for tags in options.tags}
    for number, day in enumerate(other_days(town, options.days), start=1):
        options.seed += 1  # other places
        truth = take_photos(
            options, str(day), str(town / SURFACE), out / f"photos-{day.stem}", options.photos
        )
        for tags in options.tags:
            settings = with_localizer(
                LocateSettings(
                    photos=tuple(truth), index=str(region / "index"), pose=tags == TAGS[0],
                    out=str(out / "where.geojson"),
                )
            )  # fmt: skip
            found = expect("", locate_all(settings, truth).outcomes)
            shares = [one.value for one in found.within[1:]]
            seen[tags].append(shares)
            cells = " | ".join(f"{share:.1%}" for share in shares)
            ratio = shares[-1] / max(promised[tags].within[-1].value, 1e-9)
            print(f"| day {number}, {tags} | {cells} | {ratio:.2f} x |", flush=True)
    for tags, days in seen.items():
        days_D2 = np.array(days)
        error_2 = days_D2.std(axis=0, ddof=1) / len(days) ** 0.5 if len(days) > 1 else [0.0, 0.0]
        for at, metres in enumerate(WITHIN_M[1:]):
            told = promised[tags].within[1 + at].value
            mean = days_D2[:, at].mean()
            print(
                f"{tags}, within {metres:g} m: promised {told:.1%}, seen {mean:.1%} "
                f"(standard error {error_2[at]:.1%}, {len(days)} days): "
                f"{100 * (told - mean):+.1f} points too much"
            )


if __name__ == "__main__":
    main()
