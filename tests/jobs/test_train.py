"""The training job: in this process and on Ray, to the end, on after a kill, and refused where it
cannot run.
"""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from jobs.command_line.cli import expand
from jobs.train import main
from jobs.training.checkpoints import read_checkpoint
from jobs.training.driver import train
from jobs.training.recipes.pvda import paper
from jobs.training.settings import RECIPE, RunConfig
from jobs.training.state import WorkerContext
from jobs.training.worker import train_worker
from model.checkpoint import build_encoder, dumps, loads
from model.config import LossWeights
from model.errors import CheckpointError
from pipeline.core.arrays import Pixels
from pipeline.core.errors import InputError
from pipeline.images.decode import DecodeError, decode
from pipeline.shards.samples import read_samples
from tests.jobs.tiny_runs import initial_checkpoint, rows, rows_of, settings, tiny, weights

pytestmark = pytest.mark.slow


def test_train_writes_checkpoint_curves_and_encoder(tiny_shards: str, tmp_path: Path) -> None:
    path = train(settings(tiny_shards, tmp_path, tiny()))
    checkpoint = loads(Path(path).read_bytes())
    assert checkpoint.epoch == 2
    assert checkpoint.recipe["name"] == "smoke"
    assert len(checkpoint.locations) == 6
    assert build_encoder(checkpoint)(torch.zeros(2, 3, 64, 64, dtype=torch.uint8))[1].shape == (
        2,
        2,
        16,
    )
    assert [row["epoch"] for row in rows(tmp_path)] == [1, 2]
    wanted = {
        "alpha",
        "location_loss",
        "view_loss",
        "adversarial_loss",
        "discriminator_accuracy",
        "learning_rates",
    }
    assert wanted <= set(rows(tmp_path)[0])
    board = EventAccumulator(str(tmp_path / "tensorboard"))
    board.Reload()
    assert [event.step for event in board.Scalars("location_loss")] == [1, 2]


def test_initial_checkpoint_is_the_network_before_step_one(
    tiny_shards: str, tmp_path: Path
) -> None:
    run = RunConfig(shards=tiny_shards, out=str(tmp_path), recipe=tiny(1))
    before = loads(initial_checkpoint(run))
    train(settings(tiny_shards, tmp_path, tiny(1)))
    after = loads(initial_checkpoint(run))
    assert after.epoch == 0
    assert all(
        torch.equal(before.encoder_weights[name], tensor)
        for name, tensor in after.encoder_weights.items()
    )
    assert not torch.equal(
        after.encoder_weights["backbone.conv1.weight"], weights(tmp_path)["backbone.conv1.weight"]
    )


def test_train_finished_run_is_a_no_op(
    tiny_shards: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = Path(train(settings(tiny_shards, tmp_path, tiny(1))))
    before = path.stat().st_mtime_ns
    train(settings(tiny_shards, tmp_path, tiny(1)))
    assert path.stat().st_mtime_ns == before
    assert "nothing to do" in capsys.readouterr().err
    with pytest.raises(InputError, match="with another schedule; choose another --out"):
        train(settings(tiny_shards, tmp_path, tiny(3)))


def test_run_from_before_a_setting_came_goes_on(tiny_shards: str, tmp_path: Path) -> None:
    recipe = tiny(epochs=1)
    path = Path(train(settings(tiny_shards, tmp_path, recipe)))
    trained = loads(path.read_bytes())
    older = json.loads(json.dumps(trained.recipe))
    del older["pair_repeats"], older["network"]["pooling"], older["losses"]
    path.write_bytes(dumps(replace(trained, recipe=older)))
    assert train(settings(tiny_shards, tmp_path, recipe)) == str(path)
    changed = replace(recipe, losses=LossWeights(triplet_weight=1.0))
    with pytest.raises(InputError, match="with another losses; choose another --out"):
        train(settings(tiny_shards, tmp_path, changed))


def test_train_counts_damaged_images_per_epoch(
    tiny_shards: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert [row["damaged_images"] for row in rows_of(tiny_shards, tmp_path / "whole")] == [0]
    bad = next(sample for sample in read_samples(f"{tiny_shards}/train-drone-000000.tar")).data

    def failing(data: bytes) -> Pixels:
        if data == bad:
            raise DecodeError("damaged image", "here")
        return decode(data)

    monkeypatch.setattr("pipeline.batches.ordered.decode", failing)
    told: list[dict[str, object]] = []
    run = RunConfig(shards=tiny_shards, out=str(tmp_path / "run"), recipe=tiny(4), probe_epochs=0)
    train_worker(
        run, WorkerContext(gather=lambda damage: [damage, (2, "another-worker's")]), told.append
    )
    counts = [row["damaged_images"] for row in rows(tmp_path / "run")]
    assert set(counts) == {
        2,
        3,
    }  # 6 of the 18 UAV images are drawn in an epoch, and another worker's come in addition
    notes = [str(facts["note"]) for facts in told if "note" in facts]
    assert len(notes) == 4
    assert all(note.startswith(f"epoch {number}: ") for number, note in enumerate(notes, start=1))
    for number, note in zip(counts, notes, strict=True):
        assert f": {number} images could not be decoded" in note
        assert ("the first of them is train-drone-" in note) == (number == 3)


def test_train_row_has_losses_gradients_and_view_gap(tiny_shards: str, tmp_path: Path) -> None:
    train(settings(tiny_shards, tmp_path, replace(tiny(2), hold_out=0.5), probe_epochs=2))
    first, second = rows(tmp_path)
    wanted = {
        f"location_loss/{view}/ring{ring}" for view in ("drone", "satellite") for ring in (1, 2)
    }
    wanted |= {
        f"{loss}/{view}"
        for loss in ("location_loss", "view_loss", "adversarial_loss", "discriminator_accuracy")
        for view in ("drone", "satellite")
    }
    wanted |= {f"gradient_norm/{network}" for network in ("encoder", "classifier", "discriminator")}
    assert wanted <= set(first)
    looked = {
        "view_gap/accuracy",
        "view_gap/distance",
        "held_out/drone_to_satellite/r1",
        "held_out/satellite_to_drone/ap",
    }
    assert not looked & set(first)
    assert looked <= set(second)
    board = EventAccumulator(str(tmp_path / "tensorboard"))
    board.Reload()
    assert wanted | looked <= set(board.Tags()["scalars"])


def test_train_starts_from_given_weights(tiny_shards: str, tmp_path: Path) -> None:
    recipe = tiny(1)
    run = RunConfig(shards=tiny_shards, out=str(tmp_path), recipe=replace(recipe, seed=9))
    other = build_encoder(loads(initial_checkpoint(run))).backbone.state_dict()
    torch.save(other | {"fc.weight": torch.zeros(3)}, tmp_path / "other.pth")
    still = replace(recipe, optimization=replace(recipe.optimization, backbone_lr=0.0))
    train(settings(tiny_shards, tmp_path / "run", still, weights=str(tmp_path / "other.pth")))
    trained = weights(tmp_path / "run")
    assert torch.equal(trained["backbone.layer4.0.conv1.weight"], other["layer4.0.conv1.weight"])
    with pytest.raises(CheckpointError, match="no weights at"):
        train(settings(tiny_shards, tmp_path / "run2", recipe, weights=str(tmp_path / "none.pth")))


def test_train_names_damaged_checkpoint(tiny_shards: str, tmp_path: Path) -> None:
    (tmp_path / "last.pt").write_bytes(b"PK\x03\x04 torn")
    with pytest.raises(CheckpointError, match=r"last.pt is damaged .*copy it again"):
        read_checkpoint(RunConfig(shards=tiny_shards, out=str(tmp_path), recipe=tiny()))


def test_train_too_few_images_is_rejected_at_once(tiny_shards: str, tmp_path: Path) -> None:
    with pytest.raises(
        InputError,
        match="has 6 satellite and 18 UAV training images; expected at least one batch of 8",
    ):
        train(settings(tiny_shards, tmp_path, paper()))


def test_train_unknown_recipe_names_the_known_ones() -> None:
    with pytest.raises(
        InputError, match="unknown recipe 'papr', expected one of: paper, paper_384, "
    ):
        expand(main, ["papr", "--shards", "x"], RECIPE, None)
    assert expand(main, ["--help"], RECIPE, None) == (None, ["--help"])


def test_recipe_paper_has_the_papers_settings() -> None:
    recipe = paper()
    assert (
        recipe.network.backbone,
        recipe.network.width,
        recipe.network.image_size,
        recipe.network.parts,
    ) == (
        "resnet50",
        1.0,
        256,
        4,
    )
    assert (
        recipe.network.part_dim,
        recipe.network.dropout,
        recipe.network.discriminator_channels,
    ) == (512, 0.75, 1024)
    rates = recipe.optimization
    assert (rates.optimizer, rates.momentum, rates.weight_decay) == ("sgd", 0.9, 5e-4)
    assert (
        rates.backbone_lr,
        rates.head_lr,
        rates.classifier_lr,
        rates.discriminator_lr,
    ) == (
        0.001,
        0.01,
        0.01,
        0.002,
    )
    assert (recipe.schedule.epochs, recipe.schedule.period, recipe.schedule.decay_epochs) == (
        560,
        140,
        (60, 120),
    )
    assert (recipe.batch_size, recipe.augmentation.pad, recipe.augmentation.rotation) == (8, 10, 90)
