"""Does the adversary help? PVDA, its two ablations and its control, on flights over real overhead
images.

In: a folder of 1,000 overhead images. Out: one line per figure on the terminal, `results.json` with
every run. All runs start from one backbone that was first trained on made-up towns with the
location loss alone (the paper starts from ImageNet), take the same steps on the same data, and
differ in the recipe's schedule of alpha and rates only; three seeds each. Run again, it goes on
after the last finished run.

    python benchmarks/ablation.py --textures IMAGES --out DIR

`--other-sensor` gives all satellite images another camera's look: a gap between the views that the adversary could close.
`--alpha-scale`, `--discriminator-rate` and `--joint-bn` vary what the paper and LPN fix.
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
from PIL import Image, ImageFilter
from torch import Tensor

from jobs.training.probes import view_gap
from jobs.training.recipes import RECIPES, Recipe, smoke
from model.config import Optimization
from model.inference.embed import embed
from model.schedule import schedule_at
from model.training import Training
from model.weights.load import load_backbone
from pipeline.batches.ordered import decode_samples
from pipeline.batches.training import StreamConfig, TrainingStream
from pipeline.core.records import Split, View
from pipeline.images.transforms import Augmentation
from pipeline.retrieval.metrics import summarise
from pipeline.retrieval.ranking import Side, rank, side_of_array
from pipeline.shards.manifest import read_manifest
from pipeline.shards.pack import pack
from pipeline.shards.samples import read_shard
from pipeline.shards.settings import PackingSettings
from pipeline.simulation.settings import SimulationSettings
from pipeline.simulation.simulate import simulate
from pipeline.sources.university1652 import University1652

Watch = Callable[[Training, int, dict[str, float]], None]
"Called after each epoch with its number and mean losses."
COMPARED = ("alpha_zero", "constant_alpha", "no_restart", "paper")
IMAGE = 64
PAPER_PERIOD = 140
PROBED = 256
"Images of each view that the probe for the views' gap is shown."
VARIED = ("period", "alpha_scale", "discriminator_rate", "other_sensor", "joint_bn")
"Arguments that a row of the results is for, beside recipe and seed."


def scaled(name: str, period: int, alpha_scale: float, discriminator_lr: float) -> Recipe:
    """A recipe of the paper with its schedule shrunk to four periods of `period` epochs, on the
    small network.
    """
    of_paper = RECIPES[name]().schedule

    def shrunk(epoch: int) -> int:
        return round(epoch * period / PAPER_PERIOD)

    schedule = replace(
        of_paper,
        epochs=4 * period,
        period=period,
        alpha=of_paper.alpha * alpha_scale,
        alpha_step=of_paper.alpha_step * alpha_scale,
        decay_epochs=tuple(shrunk(epoch) for epoch in of_paper.decay_epochs),
    )
    # The paper's rates of the encoder times ten: a thirtieth of its steps have to do.
    rates = Optimization(
        backbone_lr=0.01,
        head_lr=0.1,
        classifier_lr=0.1,
        discriminator_lr=discriminator_lr,
    )
    return replace(
        smoke(),
        name=name,
        schedule=schedule,
        optimization=rates,
        augmentation=Augmentation(pad=4, rotation=180),
    )


def flights(out: Path, name: str, other_sensor: bool = False, **counts: Any) -> str:
    """Simulated flights as shards; kept from run to run."""
    shards = out / f"{name}-shards"
    if not (shards / "manifest.json").exists():
        root = simulate(SimulationSettings(out=str(out / f"{name}-flights"), size=96, **counts))
        if other_sensor:
            for path in root.glob("*/*satellite/*/*.jpg"):
                seen_by_another(path)
        pack(University1652(), PackingSettings(root=str(root), out=str(shards)))
    return str(shards)


def seen_by_another(path: Path) -> None:
    """An image as a hazier, duller, greener and softer camera would have taken it, in its place."""
    with Image.open(path) as image:
        soft_HW3 = (
            np.asarray(image.convert("RGB").filter(ImageFilter.GaussianBlur(0.8)), np.float32) / 255
        )
    grey_HW1 = soft_HW3.mean(2, keepdims=True)
    dull_HW3 = 0.35 * soft_HW3 + 0.65 * grey_HW1
    seen_HW3 = 0.3 + 0.55 * dull_HW3**1.3 * np.array([0.85, 1.1, 0.8], np.float32)
    Image.fromarray((255 * seen_HW3.clip(0, 1)).astype(np.uint8)).save(path, quality=90)


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
                    for pair in decode_samples(read_shard(shards, shard.name), IMAGE, 2, 64)
                ]
                pixels = np.stack([image for _, image in samples if isinstance(image, np.ndarray)])
                self.images[split, view] = torch.from_numpy(pixels.transpose(0, 3, 1, 2))
                self.locations[split, view] = np.asarray(
                    [sample.facts["location"] for sample, _ in samples], np.str_
                )

    def measure(self, training: Training) -> dict[str, float]:
        """R@1 and AP both ways, and the distance of the two views' mean unit embeddings."""
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
        for query, gallery, label in (
            (View.DRONE, View.SATELLITE, "d2s"),
            (View.SATELLITE, View.DRONE, "s2d"),
        ):
            ranking = rank(side(Split.QUERY, query), side(Split.GALLERY, gallery))
            scores = summarise(
                ranking.first_rank_Q, ranking.ap_Q, len(self.locations[Split.GALLERY, gallery])
            )
            measures |= {f"{label}_r1": scores.r1, f"{label}_ap": scores.ap}
        means = [vectors[Split.GALLERY, view].mean(0) for view in (View.DRONE, View.SATELLITE)]
        return measures | {"mean_distance": float(np.linalg.norm(means[0] - means[1]))}

    def gap(self, training: Training) -> dict[str, float]:
        """How well a fresh linear probe tells the views of unseen places apart, by their pooled
        maps.
        """
        encoder = training.learner.encoder.eval()
        pooled = []
        with torch.no_grad():
            for view in (View.DRONE, View.SATELLITE):
                some = self.images[Split.GALLERY, view][:PROBED]
                pooled.append(
                    torch.cat(
                        [encoder(part)[0].mean((2, 3)) for part in torch.split(some, 128)]
                    ).numpy()
                )
        encoder.train()
        return view_gap(*pooled)


def run(recipe: Recipe, shards: str, backbone: dict[str, Tensor] | None, watch: Watch) -> Training:
    """Train a recipe in this process."""
    torch.manual_seed(recipe.seed)
    reading = StreamConfig(
        batch_size=recipe.batch_size,
        image_size=IMAGE,
        augmentation=recipe.augmentation,
        seed=recipe.seed,
        threads=2,
    )
    stream = TrainingStream(shards, reading)
    training = Training(
        recipe.network,
        recipe.optimization,
        len(stream.classes),
        adversary=recipe.adversary,
        joint_bn=recipe.joint_bn,
    )
    if backbone is not None:
        load_backbone(training.learner.encoder.backbone, backbone, "the backbone from towns")
    for epoch in range(recipe.schedule.epochs):
        sums: dict[str, float] = {}
        for step, (drone, satellite) in enumerate(stream.epoch(epoch)):
            now = schedule_at(recipe.schedule, epoch + step / stream.steps)
            images = [torch.from_numpy(batch.images_B3HW) for batch in (drone, satellite)]
            labels = [torch.from_numpy(batch.location_B) for batch in (drone, satellite)]
            for name, value in training.step(
                images[0], labels[0], images[1], labels[1], now
            ).items():
                if value.ndim == 0:
                    sums[name] = sums.get(name, 0.0) + float(value) / stream.steps
        watch(training, epoch, sums)
    return training


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--textures", required=True, help="folder of 1,000 overhead images")
    parser.add_argument("--out", type=Path, required=True, help="folder for data sets and results")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--period", type=int, default=10, help="epochs of a period; a run has four")
    parser.add_argument(
        "--alpha-scale", type=float, default=1.0, help="alpha as a multiple of the paper's"
    )
    parser.add_argument("--recipes", nargs="*", default=list(COMPARED))
    parser.add_argument(
        "--discriminator-rate", type=float, default=0.002, help="D's learning rate [paper: 0.002]"
    )
    parser.add_argument(
        "--other-sensor", action="store_true", help="satellite images look as another camera's"
    )
    parser.add_argument(
        "--joint-bn", action="store_true", help="the encoder sees both views in one batch"
    )
    given = parser.parse_args()
    out: Path = given.out.absolute()
    towns = flights(out, "towns", train_locations=300, test_locations=1, distractors=0, views=12)
    real = flights(
        out,
        "sensor" if given.other_sensor else "real",
        given.other_sensor,
        train_locations=600,
        test_locations=300,
        distractors=100,
        views=12,
        textures=str(Path(given.textures).absolute()),
    )
    start = out / "backbone.pt"
    if not start.exists():
        recipe = replace(smoke(40), adversary=False)
        trained = run(
            recipe,
            towns,
            None,
            lambda training, epoch, sums: print("towns", epoch + 1, sums, flush=True),
        )
        torch.save(trained.learner.encoder.backbone.state_dict(), start)
    backbone = torch.load(start, weights_only=True)
    test = TestSet(real)
    results = out / "results.json"
    varied = {name: getattr(given, name) for name in VARIED}
    for seed in range(given.seeds):
        for name in given.recipes:
            rows: list[dict[str, Any]] = json.loads(results.read_text()) if results.exists() else []
            known = {"recipe": name, "seed": seed} | varied
            if any(known.items() <= row.items() for row in rows):
                continue
            recipe = scaled(name, given.period, given.alpha_scale, given.discriminator_lr)
            recipe = replace(recipe, seed=seed, joint_bn=given.joint_bn)
            began, curve = time.monotonic(), []

            def watch(training: Training, epoch: int, sums: dict[str, float]) -> None:
                if (epoch + 1) % given.period == 0:
                    curve.append({"epoch": epoch + 1} | sums | test.gap(training))  # noqa: B023

            measured = test.measure(run(recipe, real, backbone, watch))
            rows.append(known | measured | {"curve": curve, "seconds": time.monotonic() - began})
            print(
                name,
                seed,
                {key: round(value, 4) for key, value in (curve[-1] | measured).items()},
                flush=True,
            )
            results.write_text(json.dumps(rows, indent=1))
    report(json.loads(results.read_text()))


def report(rows: list[dict[str, Any]]) -> None:
    """One line per recipe and setting: mean and standard deviation over the seeds, percent."""
    for setting in sorted({tuple(row[name] for name in (*VARIED, "recipe")) for row in rows}):
        same = [row for row in rows if tuple(row[name] for name in (*VARIED, "recipe")) == setting]
        said = [
            f"{name} {_spread([100 * row[name] for row in same])}"
            for name in ("d2s_r1", "d2s_ap", "s2d_r1", "s2d_ap")
        ]
        gaps = [
            statistics.mean(row["curve"][part]["view_gap/accuracy"] for row in same)
            for part in range(4)
        ]
        distances = [
            statistics.mean(row["curve"][part]["view_gap/distance"] for row in same)
            for part in range(4)
        ]
        deceived = statistics.mean(row["curve"][-1]["discriminator_accuracy"] for row in same)
        about = ", ".join(
            f"{name} {value}" for name, value in zip(VARIED, setting[:-1], strict=True)
        )
        print(
            f"ablation: {setting[-1]} ({about}), {len(same)} seeds: {', '.join(said)}, D's accuracy {deceived:.3f}, "
            f"probe's accuracy {gaps[0]:.3f} {gaps[1]:.3f} {gaps[2]:.3f} {gaps[3]:.3f}, "
            f"distance of the views {distances[0]:.3f} {distances[1]:.3f} {distances[2]:.3f} {distances[3]:.3f}"
        )


def _spread(values: list[float]) -> str:
    return (
        f"{statistics.mean(values):.2f} +- {statistics.stdev(values) if len(values) > 1 else 0:.2f}"
    )


if __name__ == "__main__":
    main()
