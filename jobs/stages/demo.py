"""The demo: every stage on one machine, from simulated flights to located photos.

In: a folder and sizes. Out: data set, shards, run, tables, evaluations, index and answers in that
folder. The stages are those of the other jobs, on a data set small enough for minutes on two cores.
Run again, it resumes.
"""

import csv
import io
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

from jobs.encoding.embed_test import embed_test
from jobs.stages.calibrate import calibrate_index
from jobs.stages.evaluation_tables import print_table
from jobs.stages.locate import locate_photos
from jobs.stages.settings import CalibrateSettings, DemoSettings, LocateSettings
from jobs.training.driver import train
from jobs.training.recipes.builtin import finetune
from jobs.training.settings import TrainSettings
from model.weights.builtin import BUILTIN
from pipeline.core import cluster, storage
from pipeline.core.errors import InputError
from pipeline.core.progress import console, results
from pipeline.core.records import Split, View
from pipeline.evaluation.evaluate import evaluate
from pipeline.evaluation.settings import EvaluationSettings
from pipeline.features.table import open_table
from pipeline.index.build import build_index
from pipeline.index.searcher import Index
from pipeline.index.settings import IndexSettings
from pipeline.locate.geojson import LocatedPhoto
from pipeline.locate.page import LatLon, distance_to_m, format_distance
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.simulation.settings import SimulationSettings
from pipeline.simulation.simulate import simulate
from pipeline.sources.university1652 import University1652


def demo(settings: DemoSettings) -> list[dict[str, Any]]:
    """Run every stage; returns the tuned encoder's metric rows."""
    out = storage.absolute(settings.out)
    flights, shards, trained = (storage.join(out, name) for name in ("flights", "shards", "run"))
    seconds: dict[str, float] = {}
    with step(seconds, "1 simulate", "flights over made-up towns, in University-1652's layout"):
        cluster.connect()
        simulate(
            SimulationSettings(
                out=flights,
                train_locations=settings.train_locations,
                test_locations=settings.test_locations,
                distractors=settings.distractors,
                views=settings.views,
                size=settings.size,
            )
        )
    with step(seconds, "2 pack", "images into webdataset shards"):
        pack(University1652(), PackingSettings(root=flights, out=shards))
    rows: dict[str, list[dict[str, Any]]] = {}
    folders = DemoFolders(out=out, shards=shards)
    with step(seconds, "3 built-in encoder", "test images embedded and ranked without training"):
        rows["built-in"] = embed_and_evaluate(folders, "built-in", BUILTIN)
    with step(seconds, "4 train", "it is fine-tuned on the demo's own places, by recipe finetune"):
        recipe = replace(finetune(epochs=settings.epochs), hold_out=settings.hold_out)
        checkpoint = train(TrainSettings(recipe=recipe, shards=shards, out=trained))
    with step(seconds, "5 tuned encoder", "the same images again, beside the first evaluation"):
        rows["tuned"] = embed_and_evaluate(folders, "tuned", checkpoint, trained)
    with step(seconds, "6 index", "satellite gallery into FAISS, searched with the UAV's images"):
        index, table = storage.join(out, "index"), folders.table("tuned")
        build_index(IndexSettings(table=table, out=index, split=Split.GALLERY, view=View.SATELLITE))
        console.print(search_index(index, table))
    with step(seconds, "7 locate", "a few unseen photos: where were they taken?"):
        page = locate_samples(
            DemoPaths(
                flights=flights,
                shards=shards,
                checkpoint=checkpoint,
                index=index,
                out=storage.join(out, "located"),
            )
        )
    console.rule("done")
    console.print("seconds: " + ", ".join(f"{name} {spent:.0f}" for name, spent in seconds.items()))
    chance = 1 / rows["tuned"][0]["gallery"]
    console.print(
        f"locations never seen in training, UAV -> satellite R@1: chance {chance:.2%}, built-in "
        f"{rows['built-in'][0]['r1']:.2%}, tuned {rows['tuned'][0]['r1']:.2%}"
    )
    print_table(rows["tuned"])
    print(
        f"report: {storage.join(folders.evaluation('tuned'), 'report.html')}\n"
        f"photos on the map: {page}"
    )
    return rows["tuned"]


@dataclass(frozen=True, kw_only=True)
class DemoFolders:
    """Where the demo's tables and evaluations are."""

    out: str
    shards: str

    def table(self, name: str) -> str:
        return storage.join(self.out, f"features-{name}")

    def evaluation(self, name: str) -> str:
        return storage.join(self.out, f"evaluation-{name}")


def embed_and_evaluate(
    folders: DemoFolders, name: str, checkpoint: str, run: str | None = None
) -> list[dict[str, Any]]:
    """Embed the test images and rank them, both directions; the evaluation's rows.

    `run`: the training that the encoder comes from; its report stands beside the built-in one's.
    """
    embed_test(folders.shards, checkpoint, folders.table(name))
    return evaluate(
        EvaluationSettings(
            table=folders.table(name),
            out=folders.evaluation(name),
            shards=folders.shards,
            run=run,
            beside=None if run is None else folders.evaluation("built-in"),
            by=("altitude_m",),
            title=f"Simulated flights, {name} encoder",
        )
    )


def search_index(index: str, table: str) -> str:
    """The share of UAV images whose first hit is their location, by a search of the index."""
    photos = open_table(table).select(Split.QUERY, View.DRONE)
    answers = Index(index).search(photos.embeddings(), k=1)
    right = sum(
        hits[0].location == location
        for hits, location in zip(answers, photos.labels().locations, strict=True)
    )
    return f"{right} of {len(answers)} UAV images have their location as the first hit"


@contextmanager
def step(seconds: dict[str, float], name: str, what: str) -> Iterator[None]:
    """Print the stage's name, and record its seconds."""
    console.rule(Text.assemble((name, "bold"), " ", what), align="left")
    start = time.monotonic()
    yield
    seconds[name] = time.monotonic() - start


PHOTOS = 10
"Locations to find, each by its first photo and by all of its photos together."


@dataclass(frozen=True, kw_only=True)
class DemoPaths:
    """The demo's outputs."""

    flights: str
    shards: str
    checkpoint: str
    index: str
    out: str
    "Folder for the answers."


def locate_samples(demo: DemoPaths) -> str:
    """Calibrate the index, locate photos, print the errors; returns the page's path."""
    try:
        calibrate_index(
            CalibrateSettings(checkpoint=demo.checkpoint, shards=demo.shards, index=demo.index)
        )
    except InputError as error:  # a smaller demo may hold out too few locations
        console.print(f"not calibrated: {error}")
    true_positions = read_positions(storage.join(demo.flights, "locations.csv"))
    root = storage.join(demo.flights, "test", "query_drone")
    names = sorted(name for name in true_positions if storage.is_folder(storage.join(root, name)))[
        :PHOTOS
    ]
    folders = {storage.join(root, name): true_positions[name] for name in names}
    firsts = {
        storage.join(folder, storage.list_names(folder)[0]): position
        for folder, position in folders.items()
    }
    page = storage.join(demo.out, "photos.html")
    single = LocateSettings(
        photos=tuple(firsts),
        checkpoint=demo.checkpoint,
        index=demo.index,
        shards=demo.shards,
        page=page,
        out=storage.join(demo.out, "photos.geojson"),
    )
    alone = locate_photos(single, firsts)
    by_location = storage.join(demo.out, "locations.geojson")
    together = locate_photos(
        replace(single, photos=tuple(folders), together=True, out=by_location, page=None)
    )
    table = Table(title="unseen UAV photos: how far off", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for heading in ("location", "one photo", "probability", "all photos", "probability"):
        table.add_column(
            heading, justify="left" if heading == "location" else "right", no_wrap=True
        )
    for name, one, all_ in zip(names, alone, together, strict=True):
        table.add_row(name, *_cells(one, true_positions[name]), *_cells(all_, true_positions[name]))
    results.print(table)
    return page


def read_positions(path: str) -> dict[str, LatLon]:
    """Latitude and longitude by location, as the simulator wrote them."""
    rows = csv.DictReader(io.StringIO(storage.read_bytes(path).decode()))
    return {row["location"]: (float(row["lat"]), float(row["lon"])) for row in rows}


def _cells(one: LocatedPhoto, position: LatLon) -> tuple[str, str]:
    """Distance of an answer from the true position, and its probability."""
    answer = one.answer
    if answer is None:
        return "not decoded", ""
    error = format_distance(distance_to_m(answer, position))
    probability = "" if answer.probability is None else f"{answer.probability:.0%}"
    return error if answer.known else f"unknown ({error})", probability
