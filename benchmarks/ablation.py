"""Does the adversary help? PVDA, its two ablations and its control, on real overhead images.

The input is a folder of 1,000 overhead images; the output is one line per figure on the terminal,
and `results.json` with every run. All runs start from one backbone that was first trained on
simulated towns with the location loss alone (the paper starts from ImageNet), take the same steps
on the same data, and differ in the recipe's schedule of alpha and rates only; three seeds each. The
control (alpha zero) is the baseline. A rerun resumes after the last finished run.

    python benchmarks/ablation.py --textures IMAGES --out DIR

`--other-sensor` gives all satellite images another camera's look: a gap between the views that the
adversary could close. `--alpha-scale`, `--discriminator-rate` and `--joint-bn` vary what the paper
and LPN fix.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from ablation_data import IMAGE_SIZE, TestSet, make_shards
from torch import Tensor

from jobs.training.recipes import RECIPES
from jobs.training.recipes.pvda import smoke
from jobs.training.recipes.recipe import Recipe
from model.config import Optimization
from model.schedule import schedule_at
from model.training import Training
from model.weights.load import load_backbone
from pipeline.batches.settings import StreamConfig
from pipeline.batches.training import TrainingStream
from pipeline.images.augmentation import Augmentation
from pipeline.shards.shard_set import open_shards

AfterEpoch = Callable[[Training, int, dict[str, float]], None]
"Called after each epoch with its number and mean losses."
COMPARED = ("alpha_zero", "constant_alpha", "no_restart", "paper")
PAPER_PERIOD = 140
VARIED = ("period", "alpha_scale", "discriminator_rate", "other_sensor", "joint_bn")
"Arguments that identify a row of the results, beside recipe and seed."


def scaled(name: str, period: int, alpha_scale: float, discriminator_lr: float) -> Recipe:
    """A recipe of the paper on the small network, shrunk to four periods of `period` epochs."""
    paper_schedule = RECIPES[name]().schedule

    def scale_epoch(epoch: int) -> int:
        return round(epoch * period / PAPER_PERIOD)

    schedule = replace(
        paper_schedule,
        epochs=4 * period,
        period=period,
        alpha=paper_schedule.alpha * alpha_scale,
        alpha_step=paper_schedule.alpha_step * alpha_scale,
        decay_epochs=tuple(scale_epoch(epoch) for epoch in paper_schedule.decay_epochs),
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


def run(
    recipe: Recipe, shards: str, backbone: dict[str, Tensor] | None, after_epoch: AfterEpoch
) -> Training:
    """Train a recipe in this process."""
    torch.manual_seed(recipe.seed)
    config = StreamConfig(
        batch_size=recipe.batch_size,
        image_size=IMAGE_SIZE,
        augmentation=recipe.augmentation,
        seed=recipe.seed,
        threads=2,
    )
    stream = TrainingStream(open_shards(shards), config)
    training = Training(
        recipe.network,
        recipe.optimization,
        len(stream.classes),
        adversary=recipe.adversary,
        joint_bn=recipe.joint_bn,
    )
    if backbone is not None:
        load_backbone(training.model.encoder.backbone, backbone, "the backbone from towns")
    for epoch in range(recipe.schedule.epochs):
        sums: dict[str, float] = {}
        for step, (drone, satellite) in enumerate(stream.epoch(epoch)):
            state = schedule_at(recipe.schedule, epoch + step / stream.steps)
            images = [torch.from_numpy(batch.images_B3HW) for batch in (drone, satellite)]
            labels = [torch.from_numpy(batch.location_B) for batch in (drone, satellite)]
            for name, value in training.step(
                images[0], labels[0], images[1], labels[1], state
            ).items():
                if value.ndim == 0:
                    sums[name] = sums.get(name, 0.0) + float(value) / stream.steps
        after_epoch(training, epoch, sums)
    return training


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    add = parser.add_argument
    add("--textures", required=True, help="folder of 1,000 overhead images")
    add("--out", type=Path, required=True, help="folder for data sets and results")
    add("--seeds", type=int, default=3, help="runs of each recipe")
    add("--period", type=int, default=10, help="epochs of a period; a run has four")
    add("--recipes", nargs="*", default=list(COMPARED))
    add("--alpha-scale", type=float, default=1.0, help="alpha as a multiple of the paper's")
    add("--discriminator-rate", type=float, default=0.002, help="D's learning rate [paper: 0.002]")
    add("--other-sensor", action="store_true", help="satellite images look as another camera's")
    add("--joint-bn", action="store_true", help="the encoder sees both views in one batch")
    add("--town-epochs", type=int, default=40, help="epochs of the backbone's first training")
    add("--scale", type=float, default=1.0, help="fraction of the locations: 300 towns, 1,000 real")
    args = parser.parse_args()
    out: Path = args.out.absolute()
    # At least a batch of locations to train on.
    towns, train = (max(16, round(args.scale * count)) for count in (300, 600))
    queried, distractors = (max(2, round(args.scale * count)) for count in (300, 100))
    real = make_shards(
        out,
        "sensor" if args.other_sensor else "real",
        args.other_sensor,
        train_locations=train,
        test_locations=queried,
        distractors=distractors,
        views=12,
        textures=str(Path(args.textures).absolute()),
    )
    backbone = pretrained_backbone(out, towns, args.town_epochs)
    test = TestSet(open_shards(real))
    varied = {name: getattr(args, name) for name in VARIED}
    for seed in range(args.seeds):
        for name in args.recipes:
            rows = read_results(out)
            known = {"recipe": name, "seed": seed} | varied
            if any(known.items() <= row.items() for row in rows):
                continue
            recipe = scaled(name, args.period, args.alpha_scale, args.discriminator_rate)
            recipe = replace(recipe, seed=seed, joint_bn=args.joint_bn)
            begin, curve = time.monotonic(), []

            def after_epoch(training: Training, epoch: int, sums: dict[str, float]) -> None:
                if (epoch + 1) % args.period == 0:
                    curve.append({"epoch": epoch + 1} | sums | test.gap(training))  # noqa: B023

            measures = test.measure(run(recipe, real, backbone, after_epoch))
            rows.append(known | measures | {"curve": curve, "seconds": time.monotonic() - begin})
            figures = {key: round(value, 4) for key, value in (curve[-1] | measures).items()}
            print(name, seed, figures, flush=True)
            (out / "results.json").write_text(json.dumps(rows, indent=1))
    report(read_results(out))


def pretrained_backbone(out: Path, towns: int, epochs: int) -> dict[str, Tensor]:
    """Weights trained on simulated towns with the location loss alone; kept from call to call."""
    path = out / "backbone.pt"
    if not path.exists():
        shards = make_shards(
            out, "towns", train_locations=towns, test_locations=1, distractors=0, views=12
        )

        def after_epoch(training: Training, epoch: int, sums: dict[str, float]) -> None:
            print("towns", epoch + 1, sums, flush=True)

        trained = run(replace(smoke(epochs), adversary=False), shards, None, after_epoch)
        torch.save(trained.model.encoder.backbone.state_dict(), path)
    weights: dict[str, Tensor] = torch.load(path, weights_only=True)
    return weights


def read_results(out: Path) -> list[dict[str, Any]]:
    path = out / "results.json"
    rows: list[dict[str, Any]] = json.loads(path.read_text()) if path.exists() else []
    return rows


def report(rows: list[dict[str, Any]]) -> None:
    """One line per recipe and setting: mean and standard deviation over the seeds, percent."""
    for setting in sorted({tuple(row[name] for name in (*VARIED, "recipe")) for row in rows}):
        same = [row for row in rows if tuple(row[name] for name in (*VARIED, "recipe")) == setting]
        measures = ", ".join(
            f"{name} {_spread([100 * row[name] for row in same])}"
            for name in ("d2s_r1", "d2s_ap", "s2d_r1", "s2d_ap")
        )
        accuracy, distance = (
            " ".join(
                f"{statistics.mean(row['curve'][part][f'view_gap/{measure}'] for row in same):.3f}"
                for part in range(4)
            )
            for measure in ("accuracy", "distance")
        )
        deceived = statistics.mean(row["curve"][-1]["discriminator_accuracy"] for row in same)
        flags = ", ".join(
            f"{name} {value}" for name, value in zip(VARIED, setting[:-1], strict=True)
        )
        print(
            f"ablation: {setting[-1]} ({flags}), {len(same)} seeds: {measures}, D's accuracy "
            f"{deceived:.3f}, probe's accuracy {accuracy}, distance of the views {distance}"
        )


def _spread(values: list[float]) -> str:
    deviation = statistics.stdev(values) if len(values) > 1 else 0
    return f"{statistics.mean(values):.2f} +- {deviation:.2f}"


if __name__ == "__main__":
    main()
