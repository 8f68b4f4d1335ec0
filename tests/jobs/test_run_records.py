"""The records of a run: archived checkpoints, sums of metrics, and the options that keep them."""

import json
from dataclasses import asdict, replace
from typing import Any

import pytest
import torch

from jobs.training.checkpoints import CheckpointWriter, find_checkpoint
from jobs.training.metrics import MetricAccumulator, NotFinite
from jobs.training.recipes.pvda import smoke
from jobs.training.recipes.recipe import Recipe
from jobs.training.settings import RunConfig, RunOptions
from model.checkpoint import Checkpoint
from model.errors import CheckpointError
from model.pvda import FeatureEncoder
from pipeline.core import storage
from pipeline.core.errors import InputError


def tiny(epochs: int = 3) -> Recipe:
    """Three steps an epoch on the tiny world's six satellite images."""
    recipe = smoke(epochs)
    network = replace(recipe.network, part_dim=16, discriminator_channels=16, dropout=0.5)
    return replace(recipe, network=network, batch_size=2)


def made(epoch: int, step: int = 0) -> Checkpoint:
    recipe = tiny()
    return Checkpoint(
        network=recipe.network,
        recipe=json.loads(json.dumps(asdict(recipe))),
        locations=[],
        epoch=epoch,
        step=step,
        history=[],
        state={"modules": {"encoder": FeatureEncoder(recipe.network).state_dict()}},
        metric_sums={"x": torch.tensor(0.1)},
    )


def test_checkpoints_on_any_storage() -> None:
    run = RunConfig(shards="nowhere", out="memory://run-folder/run", recipe=tiny(), keep=2)
    assert find_checkpoint(run) is None
    checkpoints = CheckpointWriter(run, None)
    for epoch in (1, 2, 3):
        checkpoints.write(made(epoch, step=epoch))
    assert storage.list_names(run.out) == ["checkpoint-0002-00002.pt", "last.pt"]
    storage.write_bytes(storage.join(run.out, "last.pt"), b"torn")
    said: list[str] = []
    found = find_checkpoint(run, said.append)
    assert found is not None
    assert (found[0], found[1].epoch, found[1].step) == ("checkpoint-0002-00002.pt", 2, 2)
    assert len(said) == 1
    CheckpointWriter(run, found).write(made(4))  # a damaged file is not kept
    assert storage.list_names(run.out) == ["checkpoint-0002-00002.pt", "last.pt"]
    storage.remove(storage.join(run.out, "last.pt"))
    assert find_checkpoint(run, said.append) is not None
    assert "last.pt is missing" in said[-1]
    storage.write_bytes(storage.join(run.out, "checkpoint-0002-00002.pt"), b"torn")
    with pytest.raises(CheckpointError, match="is not a checkpoint"):
        find_checkpoint(run)


def test_metric_accumulator_resumes_and_reports_non_finite() -> None:
    steps = [{"a": torch.tensor(0.1 * n), "b": torch.tensor(1.0 / (n + 1))} for n in range(6)]
    whole, first = MetricAccumulator(), MetricAccumulator()
    for step in steps:
        whole.add(step)
    for step in steps[:3]:
        first.add(step)
    held = first.state_dict()
    second = MetricAccumulator(first.steps, held)
    for step in steps[3:]:
        second.add(step)
    assert whole.means() == second.means()
    assert second.seconds >= float(held["seconds"]) > 0
    whole.add({"a": torch.tensor(float("inf")), "b": torch.tensor(0.0)})
    whole.add({"a": torch.tensor(float("-inf")), "b": torch.tensor(0.0)})
    with pytest.raises(NotFinite, match="a is nan"):
        whole.means()


@pytest.mark.parametrize(
    "wrong", [{"keep": 0}, {"checkpoint_epochs": 0}, {"checkpoint_minutes": -1.0}]
)
def test_run_options_reject_keeping_no_checkpoint(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=r"expected (at least 1|0 or more)"):
        RunOptions(**wrong)
