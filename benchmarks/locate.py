"""From photos to positions: single, together and as a flight, over real overhead images, and
whether the confidence is true.

In: a folder of 1,000 overhead images. Out: one line per figure on the terminal, and
reliability.svg. 900 places: about 400 to train on, 100 held out of training to calibrate by, 200 to
find, 200 more in the gallery; `smoke` trained for a few minutes. Run again, it goes on where it
was.

    python benchmarks/locate.py --textures IMAGES --out DIR

A flight visits unseen places, each time the nearest that it has not seen, with a photo of each from
a random side, at 15 m/s; the track is told that no UAV is faster than 25 m/s. Photos from outside
the gallery are those of unseen places whose images, and those around, are left out of what the
search finds; in other flights every fifth photo is one.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from jobs.calibrate import Settings as CalibrationSettings
from jobs.calibrate import calibrate_index
from jobs.encoding.encoder import make_encoder_spec
from jobs.train import Settings as TrainSettings
from jobs.train import train
from jobs.training.recipes import smoke
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
from pipeline.locate.calibrate import CalibrationExample
from pipeline.locate.calibration import Calibration
from pipeline.locate.calibration_data import LabelledImages, make_examples
from pipeline.locate.flight import apply_track, motion_for_gallery
from pipeline.locate.gallery_map import GalleryMap, read_gallery_map
from pipeline.locate.locate import Answer, answers_from_hits
from pipeline.locate.reliability import (
    ReliabilityBin,
    expected_calibration_error,
    reliability_bins,
    reliability_diagram,
)
from pipeline.locate.track import TRACK_CANDIDATES, TrackStart
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.simulation.settings import SimulationSettings
from pipeline.simulation.simulate import simulate
from pipeline.sources.university1652 import University1652

SPEED, WITHIN_M = 15.0, 25.0
FLIGHTS, STOPS, DRAWS = 8, 25, 5
"Flights, places that each visits, and how often its photos are drawn anew."
START_M = 500.0


def prepare(textures: str, out: Path, epochs: int) -> None:
    """The data, the network, the index and its calibration, as the jobs make them."""
    flights, shards, run, table, index = (
        str(out / name) for name in ("flights", "shards", "run", "table", "index")
    )
    cluster.connect()
    simulate(
        SimulationSettings(
            out=flights,
            textures=textures,
            train_locations=500,
            test_locations=200,
            distractors=200,
            views=12,
            size=96,
        )
    )
    pack(University1652(), PackingSettings(root=flights, out=shards))
    checkpoint = train(
        TrainSettings(
            recipe=replace(smoke(epochs=epochs), hold_out=0.2), shards=shards, out=run, workers=0
        )
    )
    for split, view in ((Split.QUERY, View.DRONE), (Split.GALLERY, View.SATELLITE)):
        embedding = EmbeddingSettings(shards=shards, out=table, split=split, view=view)
        embed_gallery(
            embedding, make_encoder_spec(storage.read_bytes(checkpoint), checkpoint, embedding)
        )
    build_index(IndexSettings(table=table, out=index, split=Split.GALLERY, view=View.SATELLITE))
    calibrate_index(CalibrationSettings(checkpoint=checkpoint, shards=shards, index=index))


def photos_of(table: str) -> LabelledImages:
    """The test's UAV photos with what is known of them."""
    rows = open_table(table).select(Split.QUERY, View.DRONE)
    labels = rows.labels()
    facts = [
        {"key": key, "location": location, "view": "drone", "geotag": {"lat": lat, "lon": lon}}
        for key, location, lat, lon in zip(
            *(
                values.tolist()
                for values in (labels.keys, labels.locations, labels.lats, labels.lons)
            ),
            strict=True,
        )
    ]
    return LabelledImages(records=facts, embeddings_QD=rows.embeddings())


def grouped(photos: LabelledImages, views: int) -> LabelledImages:
    """Means of `views` photos of a place, in the order of their keys."""
    order = sorted(range(len(photos.records)), key=lambda number: photos.records[number]["key"])
    groups = [order[begin : begin + views] for begin in range(0, len(order), views)]
    total_GD = np.array([photos.embeddings_QD[group].sum(axis=0) for group in groups])
    unit_GD = (total_GD / np.linalg.norm(total_GD, axis=1, keepdims=True)).astype(np.float32)
    return LabelledImages(
        records=[photos.records[group[0]] for group in groups], embeddings_QD=unit_GD
    )


def within(found: list[Answer], asked: list[CalibrationExample]) -> Doubles:
    """Which answers, known or not, lie within the tolerance: 1 or 0."""
    at_Q2 = np.array(
        [
            (one.position.lat, one.position.lon) if one.position else (np.nan, np.nan)
            for one in found
        ]
    )
    return np.asarray(
        haversine_m(at_Q2, np.array([(one.lat, one.lon) for one in asked])) <= WITHIN_M, np.float64
    )


def confidence_lines(
    name: str, asked: list[CalibrationExample], confidence: Calibration
) -> list[ReliabilityBin]:
    """How true the probabilities are, and what the threshold does, photos from inside and outside
    the gallery alike.

    Returns the bins of the reliability diagram.
    """
    inside, outside = (
        answers_from_hits([getattr(one, side) for one in asked], 5, confidence)
        for side in ("inside", "outside")
    )
    right_Q = within(inside, asked)
    said_N = np.array([one.probability for one in [*inside, *outside]], np.float64)
    bins = reliability_bins(said_N, np.concatenate([right_Q, 0 * right_Q]), np.ones(len(said_N)))
    known_Q = np.array([one.known for one in inside])
    print(f"{name}: within {WITHIN_M:.0f} m {right_Q.mean():.1%} of {len(asked)}")
    print(f"{name}: expected calibration error {expected_calibration_error(bins):.3f}")
    print(
        f"{name}: from outside the gallery, answered unknown {np.mean([not one.known for one in outside]):.1%}"
    )
    print(f"{name}: right answers lost to unknown {1 - known_Q[right_Q > 0].mean():.1%}")
    print(
        f"{name}: of the answers given inside the gallery, right {right_Q[known_Q].mean():.1%} of {known_Q.sum()}"
    )
    return bins


def flights_of(asked: list[CalibrationExample], rng: np.random.Generator) -> list[list[int]]:
    """Numbers of the photos of each flight: always to the nearest place not seen yet, a photo of
    each.
    """
    by_place: dict[str, list[int]] = {}
    for number, one in enumerate(asked):
        by_place.setdefault(one.location, []).append(number)
    left = sorted(by_place)
    place = left.pop(int(rng.integers(len(left))))
    route = [place]
    while left:
        here = asked[by_place[place][0]]
        away = [
            float(
                haversine_m(
                    np.array([here.lat, here.lon]),
                    np.array([asked[by_place[name][0]].lat, asked[by_place[name][0]].lon]),
                )
            )
            for name in left
        ]
        place = left.pop(int(np.argmin(away)))
        route.append(place)
    flights = [route[begin : begin + STOPS] for begin in range(0, STOPS * FLIGHTS, STOPS)]
    return [[int(rng.choice(by_place[name])) for name in flight] for flight in flights]


def track_lines(
    asked: list[CalibrationExample], confidence: Calibration, gallery: GalleryMap, strangers: float
) -> None:
    """Photos of flights, a share of them from outside the gallery: each by itself, as tracks, and
    with a rough start.
    """
    rng = np.random.default_rng(0)
    motion = motion_for_gallery(gallery, 25.0)
    rows: dict[str, list[tuple[bool, bool, bool]]] = {
        name: [] for name in ("single", "track", "track with start")
    }
    spent = 0.0
    for _ in range(DRAWS):
        for flight in flights_of(asked, rng):
            stops = [asked[number] for number in flight]
            strange = rng.uniform(size=len(stops)) < strangers
            at_T2 = np.array([(one.lat, one.lon) for one in stops])
            times = np.concatenate(
                [[0.0], np.cumsum(haversine_m(at_T2[1:], at_T2[:-1]) / SPEED + 1)]
            ).tolist()
            hits = [
                one.outside if odd else one.inside for one, odd in zip(stops, strange, strict=True)
            ]
            single = answers_from_hits(hits, TRACK_CANDIDATES, confidence)
            off = float(rng.uniform(-0.5, 0.5)) * START_M / 111_195
            start = TrackStart(
                lat=float(at_T2[0, 0]) + off, lon=float(at_T2[0, 1]), radius_m=START_M
            )
            begin = time.perf_counter()
            found = {
                "single": single, "track": apply_track(single, times, confidence, motion),
                "track with start": apply_track(single, times, confidence, motion, start),
            }  # fmt: skip
            spent += time.perf_counter() - begin
            for name, said in found.items():
                known = [one.known for one in said]
                rows[name] += zip(
                    strange.tolist(), known, (within(said, stops) > 0).tolist(), strict=True
                )
    for name, told in rows.items():
        odd_N, known_N, right_N = np.array(told).T
        kind = f"flights, {strangers:.0%} from outside, {name}"
        print(f"{kind}: within {WITHIN_M:.0f} m {right_N[~odd_N].mean():.1%} of the others")
        print(f"{kind}: known {known_N.mean():.1%}, of these right {right_N[known_N].mean():.1%}")
        if strangers:
            print(f"{kind}: these answered unknown {(~known_N[odd_N]).mean():.1%}")
    print(f"flights: {spent / (2 * DRAWS * FLIGHTS) * 1000:.0f} ms a track of {STOPS} photos")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--textures", required=True, help="folder of overhead images, 0.3 m a pixel"
    )
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--epochs", type=int, default=100)
    given = parser.parse_args()
    prepare(given.textures, given.out, given.epochs)
    index = Index(str(given.out / "index"))
    confidence = calibrate_index(
        CalibrationSettings(
            checkpoint=str(given.out / "run" / "last.pt"),
            shards=str(given.out / "shards"),
            index=index.path,
        )
    )
    photos = photos_of(str(given.out / "table"))
    nobody = LabelledImages(records=[], embeddings_QD=photos.embeddings_QD[:0])
    for views in (1, 3, 12):
        asked = make_examples(grouped(photos, views), nobody, index, confidence.spacing_m, WITHIN_M)
        bins = confidence_lines(
            f"{views} photo{'s together' if views > 1 else ''}", asked, confidence
        )
        if views == 1:
            picture = reliability_diagram(
                bins,
                "Probability said and share that was right, test photos inside and outside the gallery",
            )
            storage.write_bytes(str(given.out / "reliability.svg"), picture.encode())
            for strangers in (0.0, 0.2):
                track_lines(asked, confidence, read_gallery_map(index), strangers)


if __name__ == "__main__":
    main()
