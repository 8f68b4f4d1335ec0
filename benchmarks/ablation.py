"""Does the adversary help? PVDA, its two ablations and its control, on flights over real overhead images.

In: a folder of 1,000 overhead images. Out: one line per figure on the terminal, `results.json` with every run. All runs start
from one backbone that was first trained on made-up towns with the location loss alone (the paper starts from ImageNet),
take the same steps on the same data, and differ in the recipe's schedule of alpha and rates only; three seeds each.

    python benchmarks/ablation.py --textures IMAGES --out DIR
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from jobs.recipes import RECIPES, Recipe, smoke
from model.inference import embed
from model.schedule import phase
from model.training import Optimisation, Training
from model.weights import load_backbone
from pipeline.metrics import summarise
from pipeline.ranking import Side, rank, side_of_array
from pipeline.records import Split, View
from pipeline.shards import PackingSettings, pack, read_manifest
from pipeline.simulate import SimulationSettings, simulate
from pipeline.stream import Reading, TrainingStream, decoded
from pipeline.transforms import Augmentation

Watch = Callable[[Training, int, dict[str, float]], None]
"Called after each epoch with its number and mean losses."
COMPARED = ("alpha_zero", "constant_alpha", "no_restart", "paper")
IMAGE = 64
PAPER_PERIOD = 140


def scaled(name: str, period: int, epochs: int, alpha_scale: float) -> Recipe:
    """A recipe of the paper with its schedule shrunk to `epochs` of four periods, on the small network."""
    of_paper = RECIPES[name]().schedule

    def shrunk(epoch: int) -> int:
        return round(epoch * period / PAPER_PERIOD)

    schedule = replace(
        of_paper,
        epochs=epochs,
        period=period,
        alpha=of_paper.alpha * alpha_scale,
        alpha_step=of_paper.alpha_step * alpha_scale,
        decay_epochs=tuple(shrunk(epoch) for epoch in of_paper.decay_epochs),
    )
    # The paper's rates times ten: a twentieth of its steps have to do.
    rates = Optimisation(backbone_rate=0.01, head_rate=0.1, classifier_rate=0.1, discriminator_rate=0.002)
    return replace(
        smoke(), name=name, schedule=schedule, optimisation=rates, augmentation=Augmentation(pad=4, rotation=180)
    )


def flights(out: Path, name: str, **counts: Any) -> str:
    """Simulated flights as shards; kept from run to run."""
    root = simulate(SimulationSettings(out=str(out / f"{name}-flights"), size=96, **counts))
    shards = str(out / f"{name}-shards")
    pack(PackingSettings(source="university1652", root=str(root), out=shards))
    return shards


class TestSet:
    """The test images of a set, decoded once."""

    def __init__(self, shards: str) -> None:
        self.images: dict[tuple[Split, View], Tensor] = {}
        self.locations: dict[tuple[Split, View], np.ndarray] = {}
        for split in (Split.QUERY, Split.GALLERY):
            for view in (View.DRONE, View.SATELLITE):
                samples = [
                    pair
                    for shard in read_manifest(shards).of(split, view)
                    for pair in decoded(shards, shard.name, IMAGE, 2, 64)
                ]
                pixels = np.stack([image for _, image in samples if isinstance(image, np.ndarray)])
                self.images[split, view] = torch.from_numpy(pixels.transpose(0, 3, 1, 2))
                self.locations[split, view] = np.asarray([sample.facts["location"] for sample, _ in samples], np.str_)

    def measure(self, training: Training) -> dict[str, float]:
        """R@1 and AP both ways, and the view gap: the distance of the two views' mean unit embeddings."""
        encoder = training.learner.encoder.eval()
        vectors = {
            key: torch.cat([embed(encoder, part) for part in torch.split(images, 128)]).numpy()
            for key, images in self.images.items()
        }
        encoder.train()

        def side(split: Split, view: View) -> Side:
            places = self.locations[split, view]
            return side_of_array(places, places, vectors[split, view])

        measures: dict[str, float] = {}
        for query, gallery, label in ((View.DRONE, View.SATELLITE, "d2s"), (View.SATELLITE, View.DRONE, "s2d")):
            ranking = rank(side(Split.QUERY, query), side(Split.GALLERY, gallery))
            scores = summarise(ranking.first_rank_Q, ranking.ap_Q, len(self.locations[Split.GALLERY, gallery]))
            measures |= {f"{label}_r1": scores.r1, f"{label}_ap": scores.ap}
        means = [vectors[Split.GALLERY, view].mean(0) for view in (View.DRONE, View.SATELLITE)]
        return measures | {"mean_distance": float(np.linalg.norm(means[0] - means[1]))}


def run(recipe: Recipe, shards: str, backbone: dict[str, Tensor] | None, watch: Watch) -> Training:
    """Train a recipe in this process."""
    torch.manual_seed(recipe.seed)
    reading = Reading(
        batch_size=recipe.batch_size, image_size=IMAGE, augmentation=recipe.augmentation, seed=recipe.seed, threads=2
    )
    stream = TrainingStream(shards, reading)
    training = Training(recipe.network, recipe.optimisation, len(stream.classes), adversary=recipe.adversary)
    if backbone is not None:
        load_backbone(training.learner.encoder.backbone, backbone, "the backbone from towns")
    for epoch in range(recipe.schedule.epochs):
        sums: dict[str, float] = {}
        for step, (drone, satellite) in enumerate(stream.epoch(epoch)):
            now = phase(recipe.schedule, epoch + step / stream.steps)
            images = [torch.from_numpy(batch.images_B3HW) for batch in (drone, satellite)]
            labels = [torch.from_numpy(batch.location_B) for batch in (drone, satellite)]
            for name, value in training.step(images[0], labels[0], images[1], labels[1], now).items():
                if value.ndim == 0:
                    sums[name] = sums.get(name, 0.0) + float(value) / stream.steps
        watch(training, epoch, sums)
    return training


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--textures", required=True, help="folder of 1,000 overhead images")
    parser.add_argument("--out", type=Path, required=True, help="folder for data sets and results")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--period", type=int, default=6, help="epochs of a period; a run has four")
    parser.add_argument("--alpha-scale", type=float, default=1.0, help="alpha as a multiple of the paper's")
    parser.add_argument("--recipes", nargs="*", default=list(COMPARED))
    given = parser.parse_args()
    out: Path = given.out.absolute()
    towns = flights(out, "towns", train_locations=300, test_locations=1, distractors=0, views=12)
    real = flights(
        out,
        "real",
        train_locations=600,
        test_locations=300,
        distractors=100,
        views=12,
        textures=str(Path(given.textures).absolute()),
    )
    start = out / "backbone.pt"
    if not start.exists():
        recipe = replace(smoke(40), adversary=False)
        trained = run(recipe, towns, None, lambda training, epoch, sums: print("towns", epoch + 1, sums, flush=True))
        torch.save(trained.learner.encoder.backbone.state_dict(), start)
    backbone = torch.load(start, weights_only=True)
    test = TestSet(real)
    results = out / "results.json"
    rows: list[dict[str, Any]] = json.loads(results.read_text()) if results.exists() else []
    for seed in range(given.seeds):
        for name in given.recipes:
            recipe = replace(scaled(name, given.period, 4 * given.period, given.alpha_scale), seed=seed)
            known = {"recipe": name, "seed": seed, "period": given.period, "alpha_scale": given.alpha_scale}
            if any(known.items() <= row.items() for row in rows):
                continue
            began, curve = time.monotonic(), []

            def watch(training: Training, epoch: int, sums: dict[str, float]) -> None:
                if (epoch + 1) % given.period == 0:
                    curve.append({"epoch": epoch + 1} | sums | test.measure(training))  # noqa: B023
                    print(name, seed, {k: round(v, 4) for k, v in curve[-1].items()}, flush=True)  # noqa: B023

            run(recipe, real, backbone, watch)
            rows.append(known | curve[-1] | {"curve": curve, "seconds": time.monotonic() - began})
            results.write_text(json.dumps(rows, indent=1))
    report(rows)


def report(rows: list[dict[str, Any]]) -> None:
    """One line per recipe: mean and standard deviation over the seeds, percent."""
    for scale, name in sorted({(row["alpha_scale"], row["recipe"]) for row in rows}):
        same = [row for row in rows if (row["alpha_scale"], row["recipe"]) == (scale, name)]
        said = []
        for measure in ("d2s_r1", "d2s_ap", "s2d_r1", "s2d_ap"):
            values = [100 * row[measure] for row in same]
            said.append(
                f"{measure} {statistics.mean(values):.2f} +- {statistics.stdev(values) if len(values) > 1 else 0:.2f}"
            )
        gap = statistics.mean(row["mean_distance"] for row in same)
        print(
            f"ablation: {name} (alpha x {scale}), {len(same)} seeds: {', '.join(said)}, distance of view means {gap:.3f}"
        )


if __name__ == "__main__":
    main()
