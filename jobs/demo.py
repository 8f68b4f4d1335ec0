"""The whole road on one machine: `demo.py [--out DIR]`. Simulate, pack, train, embed, index, evaluate, report, locate.

Every stage is the one that the other jobs run, on a data set small enough for minutes on two cores. Run again, it goes on
where it was.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from rich.text import Text

from jobs.cli import run
from jobs.demo_photos import Demo, locate_some
from jobs.encoders import network_of
from jobs.evaluate import print_table
from jobs.recipes import smoke
from jobs.run_folder import Run
from jobs.train import Settings as TrainSettings
from jobs.train import train
from jobs.training_loop import untrained
from pipeline import cluster, storage
from pipeline.embed import EmbeddingSettings, embed_gallery
from pipeline.evaluation import EvaluationSettings, evaluate
from pipeline.features import open_table
from pipeline.index import Index
from pipeline.index_build import IndexSettings, build_index
from pipeline.packing import PackingSettings, pack
from pipeline.progress import console
from pipeline.records import Split, View
from pipeline.simulate import SimulationSettings, simulate
from pipeline.sources.university1652 import University1652


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Where the demo works, and how much it does."""

    out: str = "runs/demo"
    "Folder for everything that it makes."
    train_locations: int = 230
    "Places to learn from, with those held out."
    hold_out: float = 0.13
    "Share of these that is not learnt from: how sure answers are is calibrated by them."
    test_locations: int = 100
    "Places to find; none of them is seen in training."
    distractors: int = 50
    "Places in the gallery only."
    views: int = 12
    "UAV images per place."
    size: int = 128
    "Side of the images in pixels."
    epochs: int = smoke().schedule.epochs
    "Epochs of recipe smoke."


def demo(settings: Settings) -> list[dict[str, Any]]:
    """Go the whole road; returns the trained network's metric rows."""
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
    with step(seconds, "3 train", "PVDA from scratch by recipe smoke: small, quick, the same two-step method"):
        recipe = replace(smoke(epochs=settings.epochs), hold_out=settings.hold_out)
        checkpoint = train(TrainSettings(recipe=recipe, shards=shards, out=trained))
        start = storage.join(out, "untrained.pt")
        if not storage.exists(start):
            storage.write_bytes(start, untrained(Run(shards=shards, out=trained, recipe=recipe)))
    rows: dict[str, list[dict[str, Any]]] = {}
    for number, (name, file) in enumerate({"untrained": start, "trained": checkpoint}.items()):
        table, results = storage.join(out, f"features-{name}"), storage.join(out, f"evaluation-{name}")
        with step(
            seconds, f"{4 + 2 * number} embed", f"test images with the {name} network, one Parquet part per shard"
        ):
            for split in (Split.QUERY, Split.GALLERY):
                embedding = EmbeddingSettings(shards=shards, out=table, split=split)
                embed_gallery(embedding, network_of(storage.read_bytes(file), file, embedding))
        with step(seconds, f"{5 + 2 * number} evaluate", f"both directions and multi-query, the {name} network"):
            rows[name] = evaluate(
                EvaluationSettings(
                    table=table,
                    out=results,
                    shards=shards,
                    run=trained if name == "trained" else None,
                    beside=storage.join(out, "evaluation-untrained") if name == "trained" else None,
                    by=("altitude_m",),
                    title=f"PVDA on simulated flights, {name}",
                )
            )
    with step(seconds, "8 index", "satellite gallery into FAISS, asked with the UAV's images"):
        index = storage.join(out, "index")
        build_index(IndexSettings(table=table, out=index, split=Split.GALLERY, view=View.SATELLITE))
        console.print(ask(index, table))
    with step(seconds, "9 locate", "a few unseen photos: where were they taken?"):
        page = locate_some(
            Demo(flights=flights, shards=shards, checkpoint=checkpoint, index=index, out=storage.join(out, "located"))
        )
    console.rule("done")
    console.print("seconds: " + ", ".join(f"{name} {spent:.0f}" for name, spent in seconds.items()))
    chance = 1 / rows["trained"][0]["gallery"]
    console.print(
        f"places never seen in training, UAV -> satellite R@1: chance {chance:.2%}, untrained "
        f"{rows['untrained'][0]['r1']:.2%}, trained {rows['trained'][0]['r1']:.2%}"
    )
    print_table(rows["trained"])
    print(f"report: {storage.join(out, 'evaluation-trained', 'report.html')}\nphotos on the map: {page}")
    return rows["trained"]


def ask(index: str, table: str) -> str:
    """How many UAV images of places never seen find their place first, asked of the index as a user would."""
    photos = open_table(table).select(Split.QUERY, View.DRONE)
    answers = Index(index).search(photos.embeddings(), k=1)
    right = sum(hits[0].location == place for hits, place in zip(answers, photos.labels().locations, strict=True))
    return f"{right} of {len(answers)} UAV images find their place at the first attempt"


@contextmanager
def step(seconds: dict[str, float], name: str, what: str) -> Iterator[None]:
    """Say what begins, and keep how long it took."""
    console.rule(Text.assemble((name, "bold"), " ", what), align="left")
    start = time.monotonic()
    yield
    seconds[name] = time.monotonic() - start


def main(settings: Settings) -> None:
    """Make a data set, train on it, and find places that were never seen: minutes on two cores."""
    demo(settings)


if __name__ == "__main__":
    run(main)
