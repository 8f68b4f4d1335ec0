"""The benchmark of methods: one data set, and each method trained, embedded and evaluated on it.

In: the methods' names and a budget. Out: a folder per method and seed, and the leaderboard. The
stages are those of the other jobs, each of which keeps what is finished.
"""

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch.utils.flop_counter import FlopCounterMode

from jobs.encoding.embed_test import embed_test
from jobs.encoding.encoder import read_checkpoint_bytes
from jobs.stages.benchmark_settings import BenchmarkSettings
from jobs.training.driver import train
from jobs.training.equal_budget import at_equal_budget
from jobs.training.recipes import RECIPES
from jobs.training.recipes.builtin import builtin
from jobs.training.recipes.recipe import Recipe
from jobs.training.settings import TrainSettings
from model.checkpoint import build_encoder, loads
from pipeline.core import cluster, storage
from pipeline.core.progress import console, results
from pipeline.core.records import Split, View
from pipeline.evaluation.evaluate import evaluate
from pipeline.evaluation.leaderboard import (
    Cost,
    LeaderboardRow,
    leaderboard,
    leaderboard_markdown,
)
from pipeline.evaluation.published import PUBLISHED_SINCE, PUBLISHED_TABLE
from pipeline.evaluation.settings import EvaluationSettings
from pipeline.images.thumbnails import ImageLoader
from pipeline.report.inputs import EvaluationResults, read_evaluation
from pipeline.report.leaderboard import render_leaderboard
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.shards.shard_set import open_shards
from pipeline.shards.tile_reader import TileReader
from pipeline.simulation.settings import SimulationSettings
from pipeline.simulation.simulate import simulate
from pipeline.sources.university1652 import University1652


def benchmark(settings: BenchmarkSettings) -> str:
    """Train and judge every method that is not finished; returns the page's path."""
    out = storage.absolute(settings.out)
    cluster.connect()
    shards = storage.absolute(settings.shards) if settings.shards else simulate_simu(settings, out)
    evaluations: dict[str, list[EvaluationResults]] = {}
    costs: dict[str, Cost] = {}
    epochs = None if settings.published_sizes else epochs_of(settings.budget, shards)
    for seed in range(settings.seeds):
        for method in settings.methods:
            console.rule(f"{method}, seed {seed}", align="left")
            recipe = recipe_of(method, seed, epochs)
            evaluation, checkpoint = train_and_judge(recipe, f"{method}-seed{seed}", shards, out)
            evaluations.setdefault(method, []).append(evaluation)
            if method not in costs:
                costs[method] = cost_of(checkpoint)
            rows = leaderboard(evaluations, costs)
            firsts = {name: runs[0] for name, runs in evaluations.items()}
            # What is known by now.
            images = TileReader(open_shards(shards)).fetch
            page = write_leaderboard(settings, out, rows, firsts, images)
    results.print(leaderboard_markdown(rows), soft_wrap=True)
    print(f"leaderboard: {page}")
    return page


def simulate_simu(settings: BenchmarkSettings, out: str) -> str:
    """SimU: simulated flights in University-1652's layout and by its protocol, packed."""
    flights, shards = storage.join(out, "flights"), storage.join(out, "shards")
    simulate(
        SimulationSettings(
            out=flights,
            train_locations=settings.train_locations,
            test_locations=settings.test_locations,
            distractors=settings.distractors,
            views=settings.views,
            size=settings.size,
            textures=settings.textures,
            fill_with_towns=settings.textures is not None,
        )
    )
    pack(University1652(), PackingSettings(root=flights, out=shards))
    return shards


def epochs_of(budget: int, shards: str) -> int:
    """Whole epochs that come nearest to a budget of images of both views; at least one."""
    manifest, batch = open_shards(shards).manifest, builtin().batch_size
    images = sum(shard.samples for shard in manifest.of(Split.TRAIN, View.SATELLITE))
    return max(1, round(budget / (2 * batch * max(1, images // batch))))


def recipe_of(method: str, seed: int, epochs: int | None) -> Recipe:
    """The method on equal terms for `epochs`; None: as published."""
    recipe = RECIPES[method]()
    return replace(recipe, seed=seed) if epochs is None else at_equal_budget(recipe, epochs, seed)


def train_and_judge(
    recipe: Recipe, name: str, shards: str, out: str
) -> tuple[EvaluationResults, str]:
    """Train, embed and evaluate one run, or what of it is missing; its checkpoint beside it."""
    run, table, judged = (
        storage.join(out, folder, name) for folder in ("runs", "features", "evaluations")
    )
    checkpoint = train(
        TrainSettings(recipe=recipe, shards=shards, out=run, workers=0, probe_epochs=0)
    )
    embed_test(shards, checkpoint, table)
    evaluate(EvaluationSettings(table=table, out=judged, shards=shards, run=run, title=name))
    return read_evaluation(judged), checkpoint


def cost_of(checkpoint: str) -> Cost:
    """What a trained encoder costs: its own size and work, and its training's."""
    trained = loads(read_checkpoint_bytes(checkpoint), checkpoint)
    encoder = build_encoder(trained).requires_grad_(False)  # the counter hooks on what asks for it
    side = trained.network.image_size
    counter = FlopCounterMode(display=False)
    with counter, torch.inference_mode():
        encoder(torch.zeros(1, 3, side, side, dtype=torch.uint8))
    seconds = sum(row["seconds"] for row in trained.history)
    rates = [row["images_per_second"] for row in trained.history]
    return Cost(
        parameters=sum(parameter.numel() for parameter in encoder.parameters()),
        gmac=counter.get_total_flops() / 2e9,
        numbers=trained.network.embedding_dim,
        images_per_second=sum(rates) / max(1, len(rates)),
        minutes=seconds / 60,
    )


def write_leaderboard(
    settings: BenchmarkSettings,
    out: str,
    rows: list[LeaderboardRow],
    evaluations: Mapping[str, EvaluationResults],
    images: ImageLoader,
) -> str:
    """Write leaderboard.html, .md and .json; the page's path. `evaluations`: one of each method,
    of which the page shows queries.
    """
    terms = (
        "each method's own network, rates, batch and whole schedule"
        if settings.published_sizes
        else f"{settings.budget:,} images a training, EfficientNet-Lite0 at 128 px from ImageNet's "
        "weights, one optimizer, one batch and one augmentation for all"
    )
    data = settings.shards or (
        f"SimU: simulated flights, {settings.train_locations} training places, "
        f"{settings.test_locations} queried and {settings.distractors} distractors"
    )
    page = storage.join(out, "leaderboard.html")
    text = render_leaderboard(
        [row.as_dict() for row in rows],
        published=[
            vars(one) | {"impossible": one.impossible}
            for one in (*PUBLISHED_TABLE, *PUBLISHED_SINCE)
        ],
        data=data,
        terms=terms,
        evaluations=evaluations,
        images=images,
    )
    storage.write_bytes(page, text.encode())
    storage.write_bytes(storage.join(out, "leaderboard.md"), leaderboard_markdown(rows).encode())
    storage.write_json(storage.join(out, "leaderboard.json"), [row.as_dict() for row in rows])
    return page
