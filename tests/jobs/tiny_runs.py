"""Runs of a tiny recipe, and what they left."""

import json
from dataclasses import replace
from pathlib import Path

import torch

from jobs.training.driver import train
from jobs.training.recipes.pvda import smoke
from jobs.training.recipes.recipe import Recipe
from jobs.training.settings import RunConfig, TrainSettings
from jobs.training.state import WorkerContext, build_training, make_checkpoint, open_stream
from model.checkpoint import dumps, loads


def tiny(epochs: int = 2) -> Recipe:
    """Three steps an epoch on the tiny world's six satellite images."""
    recipe = smoke(epochs)
    network = replace(
        recipe.network, width=0.25, part_dim=16, discriminator_channels=16, dropout=0.5
    )
    return replace(recipe, network=network, batch_size=2)


def settings(shards: str, out: Path, recipe: Recipe, **changes: object) -> TrainSettings:
    given = {
        "recipe": recipe,
        "shards": shards,
        "out": str(out),
        "workers": 0,
        "checkpoint_minutes": 0.0,
    }
    return TrainSettings(**(given | changes))  # type: ignore[arg-type]


def initial_checkpoint(run: RunConfig) -> bytes:
    """The checkpoint of a run before its first step."""
    context = WorkerContext()
    stream = open_stream(run, context)
    training = build_training(run, context, len(stream.classes))
    return dumps(make_checkpoint(run, training, stream, []))


def rows(out: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]


def rows_of(shards: str, out: Path) -> list[dict[str, object]]:
    train(settings(shards, out, tiny(1)))
    return rows(out)


def weights(path: Path) -> dict[str, torch.Tensor]:
    return loads((path / "last.pt").read_bytes()).encoder_weights
