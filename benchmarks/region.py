"""From a map to a localizer: `adapt` on a map that nobody trained on, and what became of its word.

    python benchmarks/region.py --out DIR --imagery DIR [--tiles 16] [--minutes 20] [--photos 200]
    python benchmarks/region.py --out DIR [--side 1000] ...      a procedural town, another day

The map is a mosaic of overhead images, or a town with its surface model. Photos of another seed
(over the town: of another day's sun, season and haze, with relief) are then located with the
camera's tags (heading wrong by 3 degrees, pitch by 1, height by 3 %) and without: before (the
built-in encoder, tiles alone, then matched, without any fitting) and after `adapt`; matched around
the first candidate alone; with the ground taken for flat; by SIFT without dense features; and by
plain SIFT over the whole map.
Beside it: what `adapt` promised, photos of another map, and how often matching makes a right tile's
answer worse.
"""

import argparse
import json
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from own_map import make_index, make_map, write_map
from PIL import Image
from whole_map import open_whole_map

from jobs.region.adapt import adapt
from jobs.region.expect import outcome_of
from jobs.region.settings import AdaptSettings
from jobs.stages import matching
from jobs.stages.calibrate_flight import flight_of
from jobs.stages.locate import locate_photos
from jobs.stages.settings import LocateSettings
from model.weights.builtin import BUILTIN
from pipeline.camera.local_plane import LocalPlane
from pipeline.core import cluster
from pipeline.core.geo import haversine_m
from pipeline.core.records import GeoTag
from pipeline.locate import refined
from pipeline.region.expectation import (
    PRECISION,
    WITHIN_M,
    Expectation,
    Outcome,
    coverage,
    expect,
)
from pipeline.simulation.over_map.fly import TABLE, fly
from pipeline.simulation.over_map.settings import MapFlightSettings, TownMapSettings
from pipeline.simulation.over_map.town_map import ANOTHER_DAY, MAP, SURFACE, make_town_map

TAGS = ("with tags", "without")
Truth = dict[str, GeoTag]
"Where and how photos were taken, by their paths."


def make_maps(options: argparse.Namespace, out: Path, number: int) -> tuple[str, str, str | None]:
    """A map, what photos are taken over (the same ground), and its surface model. Maps of different
    numbers show different ground."""
    if options.imagery is None:
        town = make_town_map(
            TownMapSettings(
                out=str(out),
                side=options.side,
                resolution=options.resolution,
                seed=options.seed + number,
            )
        )
        return str(town / MAP), str(town / ANOTHER_DAY), str(town / SURFACE)
    out.mkdir(parents=True, exist_ok=True)
    path = out / "map.tif"
    if not path.exists():
        write_map(make_map(options.imagery, options.tiles, options.seed, number), path)
    return str(path), str(path), None


def take_photos(
    options: argparse.Namespace, over: str, surface: str | None, out: Path, count: int
) -> Truth:
    """Photos that `adapt` has not seen, with the truth."""
    flight = fly(
        MapFlightSettings(
            mosaic=over, surface=surface, out=str(out), photos=count, seed=1000 + options.seed,
            relight=False, height=tuple(options.height), pitch=tuple(options.pitch),
        )
    )  # fmt: skip
    return {photo.path: photo.truth for photo in flight_of(str(flight / TABLE), count)}


@dataclass(frozen=True, kw_only=True)
class Way:
    """How photos were located."""

    outcomes: list[Outcome]
    "In the photos' order."
    seconds: float
    "A photo."
    turns_deg: list[float]
    "Between the headings of matched photos and the true ones."


def locate_all(settings: LocateSettings, truth: Truth) -> Way:
    begin = time.perf_counter()
    located = {one.name: one for one in locate_photos(settings)}
    seconds = (time.perf_counter() - begin) / len(truth)
    answers = [(located[path].answer, tag.heading_deg) for path, tag in truth.items()]
    return Way(
        outcomes=[outcome_of(located[path], tag, settings.pose) for path, tag in truth.items()],
        seconds=seconds,
        turns_deg=[
            abs((answer.refinement.heading_deg - heading + 180) % 360 - 180)
            for answer, heading in answers
            if answer is not None and answer.refinement is not None and heading is not None
        ],
    )


def locate_by_sift(mosaic: str, truth: Truth) -> Way:
    """By plain SIFT over the whole map, whose features are found before."""
    whole, outcomes = open_whole_map(Path(mosaic)), []
    begin = time.perf_counter()
    for path, tag in truth.items():
        place = whole.place(np.asarray(Image.open(path).convert("RGB")))
        error_m = math.inf
        if place is not None:
            error_m = float(haversine_m(np.array(place), np.array((tag.lat, tag.lon))))
        outcomes.append(
            Outcome(
                name=path, error_m=error_m, known=place is not None, probability=None,
                within_m=None, refined=place is not None, posed=False, height_m=tag.altitude_m or 0,
                pitch_deg=tag.pitch_deg or 0,
            )
        )  # fmt: skip
    seconds = (time.perf_counter() - begin) / len(truth)
    return Way(outcomes=outcomes, seconds=seconds, turns_deg=[])


@contextmanager
def windows_per_photo(count: int) -> Iterator[None]:
    """Matching tries so many windows of the map."""
    usual, refined.MOST_WINDOWS = refined.MOST_WINDOWS, count
    try:
        yield
    finally:
        refined.MOST_WINDOWS = usual


@contextmanager
def flat_ground() -> Iterator[None]:
    """Matching knows nothing of a surface model."""
    usual, matching.height_reader = matching.height_reader, lambda surface: no_heights
    try:
        yield
    finally:
        matching.height_reader = usual


def no_heights(plane: LocalPlane, half_m: float) -> None:
    """As if a surface model ended there."""


def print_row(name: str, way: Way, baseline: float) -> float:
    """A row of the table; the share within 25 m."""
    found = expect(name, way.outcomes)
    within = [f"{one.value:.1%} [{one.low:.1%}, {one.high:.1%}]" for one in found.within]
    gap = "" if np.isnan(found.calibration_gap) else f"{100 * found.calibration_gap:+.1f} points"
    share = found.within[-1].value
    ratio = share / max(baseline or share, 1 / len(way.outcomes))
    turn = f"{np.median(way.turns_deg):.2f} degrees" if way.turns_deg else ""
    print(
        f"| {name} | {found.answered.value:.1%} | {' | '.join(within)} | {found.wrong.value:.1%} "
        f"| {found.median_m:.2f} m | {turn} | {gap} | {way.seconds:.2f} s | {ratio:.2f} x |",
        flush=True,
    )
    return share


def print_coverage(seen: dict[bool, list[Outcome]]) -> None:
    """The share of photos that can be answered with a precision of PRECISION."""
    for posed, outcomes in seen.items():
        shares = [f"{coverage(outcomes, PRECISION, m):.1%} within {m:g} m" for m in WITHIN_M]
        print(
            f"answered with a precision of {PRECISION:.0%}, {TAGS[not posed]}: {', '.join(shares)}"
        )


def print_promises(promised: Sequence[Expectation], seen: dict[bool, list[Outcome]]) -> None:
    """How near `what to expect` came to what was seen."""
    for way, posed in zip(promised[:2], (True, False), strict=True):
        if posed not in seen:
            continue
        found = expect("", seen[posed])
        for at, metres in ((1, 5), (2, 25)):
            told, kept = way.within[at].value, found.within[at].value
            print(f"{way.title}, within {metres} m: promised {told:.1%}, seen {kept:.1%}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--imagery", type=Path, help="overhead images; without them, a town")
    parser.add_argument("--tiles", type=int, default=16, help="images along a side of the mosaic")
    parser.add_argument("--side", type=float, default=1000.0, help="of the town, metres")
    parser.add_argument("--resolution", type=float, default=0.3, help="of the town, m a pixel")
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--photos", type=int, default=200)
    parser.add_argument("--checks", type=int, default=80)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--height", type=float, nargs=2, default=(60.0, 120.0), help="metres")
    parser.add_argument("--pitch", type=float, nargs=2, default=(-90.0, -45.0), help="degrees")
    parser.add_argument("--tile-m", type=float, nargs="+", default=[55.0], help="of each level")
    parser.add_argument("--only-after", action="store_true", help="leave out what was before adapt")
    parser.add_argument("--tags", nargs="+", default=list(TAGS), choices=TAGS)
    options = parser.parse_args()
    out: Path = options.out
    cluster.connect()
    mosaic, over, surface = make_maps(options, out / "map", 0)
    truth = take_photos(options, over, surface, out / "photos", options.photos)
    _, far, far_surface = make_maps(options, out / "elsewhere-map", 1)
    strangers = take_photos(
        options, far, far_surface, out / "elsewhere", max(1, options.photos // 4)
    )
    region = out / "region"
    begin = time.perf_counter()
    promised = adapt(
        AdaptSettings(
            mosaic=mosaic, surface=surface, out=str(region), minutes=options.minutes,
            checks=options.checks, seed=options.seed, height=tuple(options.height),
            pitch=tuple(options.pitch),
            tile_m=tuple(options.tile_m) if len(options.tile_m) > 1 else options.tile_m[0],
        )
    )  # fmt: skip
    print(f"adapt: {(time.perf_counter() - begin) / 60:.1f} minutes")
    tiles = str(region / "tiles")
    before = LocateSettings(
        photos=tuple(truth), checkpoint=BUILTIN, index=make_index(out / "before", tiles, BUILTIN),
        shards=tiles, out=str(out / "where.geojson"), match=False, surface=surface,
    )  # fmt: skip
    after = replace(before, index=str(region / "index"))
    print(
        "| photos | answered | within 1 m | within 5 m | within 25 m | wrong answers | median "
        "| heading off, median | promised too much | a photo | within 25 m, x the first row |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    baseline, seen, by_tiles = 0.0, {}, {}
    for way in options.tags:
        posed = way == TAGS[0]
        ways = {
            "before, tiles": before,
            "before, matched by rule": replace(before, match=True),
            "after, tiles": replace(after, match=False),
            "after": replace(after, match=True),
        }
        for name, settings in ways.items():
            if options.only_after and name.startswith("before"):
                continue
            found = locate_all(replace(settings, pose=posed), truth)
            share = print_row(f"{name}, {way}", found, baseline)
            baseline = baseline or share
            if name == "after":
                seen[posed] = found.outcomes
            elif name == "after, tiles":
                by_tiles[posed] = found.outcomes
        with windows_per_photo(1):
            first = locate_all(replace(after, match=True, pose=posed), truth)
        print_row(f"after, around the first candidate alone, {way}", first, baseline)
        if posed:
            alone = locate_all(replace(after, match=True, dense=False), truth)
            print_row(f"after, without dense features, {way}", alone, baseline)
        if surface is not None:
            with flat_ground():
                flat = locate_all(replace(after, match=True, pose=posed), truth)
            print_row(f"after, the ground taken for flat, {way}", flat, baseline)
    print_row("plain SIFT over the whole map, without", locate_by_sift(mosaic, truth), baseline)
    print_coverage(seen)
    print_promises(promised, seen)
    pairs = [
        pair for posed in seen for pair in zip(by_tiles[posed], seen[posed], strict=True)
        if pair[0].error_m <= 25
    ]  # fmt: skip
    worse = sum(refined.error_m > max(tile.error_m, 5) for tile, refined in pairs)
    print(f"right tiles made worse by matching (and more than 5 m off): {worse} of {len(pairs)}")
    for posed in seen:
        settings = replace(after, photos=tuple(strangers), match=True, pose=posed)
        given = sum(one.known for one in locate_all(settings, strangers).outcomes)
        print(f"photos of another map, {TAGS[not posed]}: {given} of {len(strangers)} answered")
    print(json.dumps({"minutes": options.minutes, "seed": options.seed, "photos": len(truth)}))


if __name__ == "__main__":
    main()
