"""Photos of one flight located one by one, and given the whole flight.

    python benchmarks/tracks.py --region DIR --over MAP [--surface FILE] --out DIR [--flights 4]

Flies surveys over a map that shows a region's ground (for a town: on another day), each with its
own seed, and locates their photos by the region, without the camera's tags: by tiles, each by
itself and as a track; matched with the map, each by itself; as tracks through refined places, with
odometry (its error a share of the distance) and without, by the whole flight and (online) by the
photos up to each.
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from region import Way, locate_all, print_row

from jobs.stages.calibrate_flight import flight_of
from jobs.stages.settings import LocateSettings
from pipeline.core import cluster
from pipeline.core.records import GeoTag
from pipeline.simulation.over_map.fly import ODOMETRY, TABLE, TIMES, fly
from pipeline.simulation.over_map.settings import MapFlightSettings

WAYS: Mapping[str, Mapping[str, Any]] = {
    "tiles": {"match": False},
    "tile-tracks": {"match": False, "track": True},
    "single": {},
    "tracks": {"track": True},
    "online": {"track": True, "online": True},
    "odometry": {"track": True, "odometry": ODOMETRY},
    "odometry-online": {"track": True, "odometry": ODOMETRY, "online": True},
}
"Ways to locate photos, and their settings. The first one is the baseline."


def take_flights(options: argparse.Namespace) -> list[Path]:
    """Survey flights of different seeds; their folders."""
    return [
        fly(
            MapFlightSettings(
                mosaic=options.over, surface=options.surface, photos=options.photos,
                out=str(options.out / f"flight-{number}"), plan="survey", seed=2000 + number,
                height=tuple(options.height), pitch=tuple(options.pitch),
                odometry_error=options.odometry_error, every_m=options.every_m, relight=False,
            )
        )
        for number in range(options.flights)
    ]  # fmt: skip


def locate_flights(
    options: argparse.Namespace, flights: Sequence[Path], way: Mapping[str, Any]
) -> Way:
    """All photos, one flight after the other."""
    found = []
    for flight in flights:
        photos = flight_of(str(flight / TABLE), options.photos)
        truth: dict[str, GeoTag] = {photo.path: photo.truth for photo in photos}
        settings = LocateSettings(
            photos=tuple(truth), index=str(options.region / "index"), pose=False,
            out=str(options.out / "where.geojson"),
        )  # fmt: skip
        files = {"times": TIMES} if way.get("track") else {}
        files |= {"odometry": way["odometry"]} if "odometry" in way else {}
        named = {name: str(flight / file) for name, file in files.items()}
        found.append(locate_all(replace(settings, **{**way, **named}), truth))
    return Way(
        outcomes=[outcome for one in found for outcome in one.outcomes],
        seconds=float(np.mean([one.seconds for one in found])),
        turns_deg=[turn for one in found for turn in one.turns_deg],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--region", type=Path, required=True, help="of jobs/adapt.py")
    parser.add_argument("--over", required=True, help="the map that is flown over")
    parser.add_argument("--surface", help="its surface model")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--flights", type=int, default=4)
    parser.add_argument("--photos", type=int, default=24, help="of a flight")
    parser.add_argument("--every-m", type=float, default=40.0, help="metres between photos")
    parser.add_argument("--odometry-error", type=float, default=0.05)
    parser.add_argument("--height", type=float, nargs=2, default=(60.0, 120.0), help="metres")
    parser.add_argument("--pitch", type=float, nargs=2, default=(-90.0, -60.0), help="degrees")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    options = parser.parse_args()
    cluster.connect()
    flights = take_flights(options)
    print(f"{len(flights)} flights of {options.photos} photos")
    print(
        "| photos | answered | within 1 m | within 5 m | within 25 m | wrong answers | median "
        "| heading off, median | promised too much | a photo | within 25 m, x the first row |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    baseline = 0.0
    for name in options.ways:
        share = print_row(name, locate_flights(options, flights, WAYS[name]), baseline)
        baseline = baseline or share


if __name__ == "__main__":
    main()
