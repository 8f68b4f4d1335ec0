"""From photos to positions over real overhead images, and whether the probabilities are calibrated.

The input is a folder of 1,000 overhead images; the output is one line per figure on the terminal,
and reliability.svg. 900 places: about 400 to train on, 100 held out of training to calibrate by,
200 to find, 200 more in the gallery; `smoke` trained for a few minutes. A rerun resumes.

    python benchmarks/locate.py --textures IMAGES --out DIR

Photos are located singly (the baseline), together, and as flights. A flight goes from each unseen
place to the nearest one not visited yet, with a photo of each from a random side, at 15 m/s; the
track knows that no UAV is faster than 25 m/s. Photos from outside the gallery are those of unseen
places whose images, and the images around, are excluded from the search; in the second set of
flights every fifth photo is one.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from jobs.encoding.encoder import make_encoder_spec
from jobs.stages.calibrate import calibrate_index
from jobs.stages.settings import CalibrateSettings
from jobs.training.driver import train
from jobs.training.recipes.pvda import smoke
from jobs.training.settings import TrainSettings
from pipeline.confidence.reliability import (
    ReliabilityBin,
    expected_calibration_error,
    reliability_bins,
    reliability_diagram,
)
from pipeline.core import cluster, storage
from pipeline.core.arrays import Doubles
from pipeline.core.geo import haversine_m
from pipeline.core.records import Split, View
from pipeline.features.embed import embed_gallery
from pipeline.features.settings import EmbeddingSettings
from pipeline.features.table import open_table
from pipeline.index.build import build_index
from pipeline.index.searcher import Index
from pipeline.index.settings import IndexSettings
from pipeline.locate.calibration import Calibration
from pipeline.locate.fitting.calibrate import CalibrationExample
from pipeline.locate.fitting.calibration_data import LabelledImages, make_examples
from pipeline.locate.flight import apply_track, motion_for_gallery
from pipeline.locate.gallery_map import GalleryMap, read_gallery_map
from pipeline.locate.locate import Answer, answers_from_hits
from pipeline.locate.track import TRACK_CANDIDATES, TrackStart
from pipeline.region.expectation import PRECISION, Outcome, coverage, expect
from pipeline.region.expectation import WITHIN_M as WITHIN
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.simulation.settings import SimulationSettings
from pipeline.simulation.simulate import simulate
from pipeline.sources.university1652 import University1652

SPEED_M_S, MAX_SPEED_M_S, WITHIN_M = 15.0, 25.0, 25.0
START_M = 500.0
"Radius of a track's rough start."


def prepare(args: argparse.Namespace) -> None:
    """Make the data, the network, the index and its calibration with the jobs' functions."""
    flights, shards, run, table, index = (
        str(args.out / name) for name in ("flights", "shards", "run", "table", "index")
    )
    cluster.connect()
    simulate(
        SimulationSettings(
            out=flights,
            textures=args.textures,
            train_locations=args.train_locations,
            test_locations=args.test_locations,
            distractors=args.distractors,
            views=12,
            size=96,
        )
    )
    pack(University1652(), PackingSettings(root=flights, out=shards))
    recipe = replace(smoke(epochs=args.epochs), hold_out=args.hold_out)
    checkpoint = train(TrainSettings(recipe=recipe, shards=shards, out=run, workers=0))
    for split, view in ((Split.QUERY, View.DRONE), (Split.GALLERY, View.SATELLITE)):
        embedding = EmbeddingSettings(shards=shards, out=table, split=split, view=view, workers=0)
        spec = make_encoder_spec(storage.read_bytes(checkpoint), checkpoint, embedding)
        embed_gallery(embedding, spec)
    build_index(IndexSettings(table=table, out=index, split=Split.GALLERY, view=View.SATELLITE))
    calibrate_index(CalibrateSettings(checkpoint=checkpoint, shards=shards, index=index))


def query_photos(table: str) -> LabelledImages:
    """The UAV photos of the test with their metadata."""
    rows = open_table(table).select(Split.QUERY, View.DRONE)
    labels = rows.labels()
    columns = (labels.keys, labels.locations, labels.lats, labels.lons)
    records = [
        {"key": key, "location": location, "view": "drone", "geotag": {"lat": lat, "lon": lon}}
        for key, location, lat, lon in zip(*(column.tolist() for column in columns), strict=True)
    ]
    return LabelledImages(records=records, embeddings_QD=rows.embeddings())


def group_photos(photos: LabelledImages, views: int) -> LabelledImages:
    """Means of `views` photos of a place, in the order of their keys."""
    order = sorted(range(len(photos.records)), key=lambda number: photos.records[number]["key"])
    groups = [order[begin : begin + views] for begin in range(0, len(order), views)]
    total_GD = np.array([photos.embeddings_QD[group].sum(axis=0) for group in groups])
    unit_GD = (total_GD / np.linalg.norm(total_GD, axis=1, keepdims=True)).astype(np.float32)
    return LabelledImages(
        records=[photos.records[group[0]] for group in groups], embeddings_QD=unit_GD
    )


def errors_of(answers: list[Answer], examples: list[CalibrationExample]) -> Doubles:
    """Metres from each answer's position, known or not, to the photo's; infinite without one."""
    places = [answer.position for answer in answers]
    at_Q2 = np.array([(at.lat, at.lon) if at else (np.nan, np.nan) for at in places])
    true_Q2 = np.array([(example.lat, example.lon) for example in examples])
    return np.nan_to_num(haversine_m(at_Q2, true_Q2), nan=np.inf)


def print_metres(name: str, answers: list[Answer], errors_Q: Doubles) -> None:
    """Print how far off the answers are that are given; tiles tell no heading."""
    outcomes = [
        Outcome(
            name=name, error_m=error_m, known=answer.known, probability=answer.probability,
            within_m=WITHIN_M, refined=False, posed=False, height_m=0.0, pitch_deg=0.0,
        )
        for answer, error_m in zip(answers, errors_Q.tolist(), strict=True)
    ]  # fmt: skip
    found, given_Q = expect(name, outcomes), np.array([answer.known for answer in answers])
    shares = (f"{at.value:.1%} within {m:g} m" for at, m in zip(found.within, WITHIN, strict=True))
    far_m = np.percentile(errors_Q[given_Q], 90) if given_Q.any() else np.nan
    print(
        f"{name}: answered {found.answered.value:.1%}; {', '.join(shares)}; median "
        f"{found.median_m:.1f} m, nine of ten within {far_m:.1f} m; more than {WITHIN[-1]:g} m off "
        f"{found.wrong.value:.1%} of the answers; {coverage(outcomes, PRECISION, WITHIN_M):.1%} "
        f"answered within {WITHIN_M:g} m with a precision of {PRECISION:.0%}"
    )


def print_calibration(
    name: str, examples: list[CalibrationExample], calibration: Calibration
) -> list[ReliabilityBin]:
    """Print the calibration of the probabilities and the effect of the threshold.

    Half of the photos are from outside the gallery. Returns the bins of the reliability diagram.
    """
    inside, outside = (
        answers_from_hits([getattr(example, side) for example in examples], 5, calibration)
        for side in ("inside", "outside")
    )
    errors_Q = errors_of(inside, examples)
    right_Q = (errors_Q <= WITHIN_M).astype(np.float64)
    probability_N = np.array([one.probability for one in [*inside, *outside]], np.float64)
    right_N = np.concatenate([right_Q, 0 * right_Q])
    bins = reliability_bins(probability_N, right_N, np.ones(len(probability_N)))
    known_Q = np.array([answer.known for answer in inside])
    unknown = np.mean([not answer.known for answer in outside])
    print(f"{name}: within {WITHIN_M:.0f} m {right_Q.mean():.1%} of {len(examples)}")
    print_metres(name, inside, errors_Q)
    print(f"{name}: expected calibration error {expected_calibration_error(bins):.3f}")
    print(f"{name}: from outside the gallery, answered unknown {unknown:.1%}")
    print(f"{name}: right answers lost to unknown {1 - mean_of(known_Q[right_Q > 0]):.1%}")
    print(
        f"{name}: of the answers given inside the gallery, right {mean_of(right_Q[known_Q]):.1%} "
        f"of {known_Q.sum()}"
    )
    return bins


def mean_of(values: np.ndarray) -> float:
    """The mean; nan of none, without NumPy's warning."""
    return float(values.mean()) if len(values) else float("nan")


def plan_flights(
    examples: list[CalibrationExample], flights: int, stops: int, rng: np.random.Generator
) -> list[list[int]]:
    """Photo numbers of each flight: always on to the nearest unvisited place, one photo of each."""
    by_place: dict[str, list[int]] = {}
    for number, example in enumerate(examples):
        by_place.setdefault(example.location, []).append(number)

    def position(name: str) -> np.ndarray:
        example = examples[by_place[name][0]]
        return np.array([example.lat, example.lon])

    left = sorted(by_place)
    route = [left.pop(int(rng.integers(len(left))))]
    while left:
        here = position(route[-1])
        distances = [float(haversine_m(here, position(name))) for name in left]
        route.append(left.pop(int(np.argmin(distances))))
    legs = [route[begin : begin + stops] for begin in range(0, stops * flights, stops)]
    return [[int(rng.choice(by_place[name])) for name in leg] for leg in legs if leg]


def print_tracks(
    args: argparse.Namespace,
    examples: list[CalibrationExample],
    calibration: Calibration,
    gallery: GalleryMap,
    outside_share: float,
) -> None:
    """Print photos located singly, as tracks, and as tracks with a rough start."""
    rng = np.random.default_rng(0)
    motion = motion_for_gallery(gallery, MAX_SPEED_M_S)
    rows: dict[str, list[tuple[bool, bool, bool]]] = {
        name: [] for name in ("single", "track", "track with start")
    }
    single_seconds, track_seconds, tracks = 0.0, 0.0, 0
    for _ in range(args.draws):
        for flight in plan_flights(examples, args.flights, args.stops, rng):
            stops = [examples[number] for number in flight]
            outside_T = rng.uniform(size=len(stops)) < outside_share
            at_T2 = np.array([(stop.lat, stop.lon) for stop in stops])
            legs = haversine_m(at_T2[1:], at_T2[:-1]) / SPEED_M_S + 1
            times = np.concatenate([[0.0], np.cumsum(legs)]).tolist()
            hits = [
                stop.outside if is_outside else stop.inside
                for stop, is_outside in zip(stops, outside_T, strict=True)
            ]
            begin = time.perf_counter()
            single = answers_from_hits(hits, TRACK_CANDIDATES, calibration)
            single_seconds += time.perf_counter() - begin
            north = float(rng.uniform(-0.5, 0.5)) * START_M / 111_195
            start = TrackStart(
                lat=float(at_T2[0, 0]) + north, lon=float(at_T2[0, 1]), radius_m=START_M
            )
            begin = time.perf_counter()
            found = {
                "single": single,
                "track": apply_track(single, times, calibration, motion),
                "track with start": apply_track(single, times, calibration, motion, start),
            }
            track_seconds += time.perf_counter() - begin
            tracks += 2
            for name, answers in found.items():
                known = [answer.known for answer in answers]
                right = (errors_of(answers, stops) <= WITHIN_M).tolist()
                rows[name] += zip(outside_T.tolist(), known, right, strict=True)
    for name, row in rows.items():
        outside_N, known_N, right_N = np.array(row).T
        kind = f"flights, {outside_share:.0%} from outside, {name}"
        print(f"{kind}: within {WITHIN_M:.0f} m {mean_of(right_N[~outside_N]):.1%} of the others")
        print(f"{kind}: known {known_N.mean():.1%}, of these right {mean_of(right_N[known_N]):.1%}")
        if outside_share:
            print(f"{kind}: these answered unknown {mean_of(~known_N[outside_N]):.1%}")
    print(
        f"flights: {track_seconds / tracks * 1000:.0f} ms per track of {args.stops} photos, "
        f"{track_seconds / single_seconds / 2:.1f} x the time of their single answers"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--textures", required=True, help="folder of overhead images, 0.3 m per pixel")
    add("--out", required=True, type=Path, help="folder of the artefacts and the diagram")
    add("--epochs", type=int, default=100, help="of training")
    add("--hold-out", type=float, default=0.2, help="part of the places to calibrate by")
    add("--train-locations", type=int, default=500)
    add("--test-locations", type=int, default=200)
    add("--distractors", type=int, default=200)
    add("--flights", type=int, default=8, help="flights of a draw")
    add("--stops", type=int, default=25, help="places that a flight visits")
    add("--draws", type=int, default=5, help="times that the flights' photos are drawn anew")
    args = parser.parse_args()
    prepare(args)
    index = Index(str(args.out / "index"))
    calibration = calibrate_index(
        CalibrateSettings(
            checkpoint=str(args.out / "run" / "last.pt"),
            shards=str(args.out / "shards"),
            index=index.path,
        )
    )
    photos = query_photos(str(args.out / "table"))
    none = LabelledImages(records=[], embeddings_QD=photos.embeddings_QD[:0])
    for views in (1, 3, 12):
        examples = make_examples(
            group_photos(photos, views), none, index, calibration.spacing_m, WITHIN_M
        )
        name = "1 photo" if views == 1 else f"{views} photos together"
        bins = print_calibration(name, examples, calibration)
        if views == 1:
            title = "Predicted probability and observed share, photos inside and outside"
            diagram = reliability_diagram(bins, title)
            storage.write_bytes(str(args.out / "reliability.svg"), diagram.encode())
            for outside_share in (0.0, 0.2):
                print_tracks(args, examples, calibration, read_gallery_map(index), outside_share)


if __name__ == "__main__":
    main()
