"""Recipes are the paper's and LPN's; what is resolved from them is shown before training, and told
apart from their own.
"""

import io
import math
import shutil
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from rich.console import Console

from jobs.training.config_table import config_table, print_config
from jobs.training.recipes import RECIPES
from jobs.training.recipes.lpn import lpn, lpn_pvda_rates
from jobs.training.recipes.pvda import (
    alpha_zero,
    constant_alpha,
    no_restart,
    paper,
    paper_384,
    smoke,
)
from jobs.training.recipes.recipe import Recipe
from model.backbones.resnet import ResNet
from model.checkpoint import loads
from model.config import LossWeights, PVDAConfig
from model.schedule import schedule_at
from model.training import Training
from pipeline.core.errors import InputError
from tests.launcher import Launcher


def shown(recipe: Recipe, **run: object) -> str:
    screen = io.StringIO()
    Console(width=400, file=screen).print(config_table(recipe, run))
    return screen.getvalue()


def differing(recipe: Recipe) -> set[str]:
    """The parts in which a recipe is not `paper`, its name apart."""
    return {
        field.name
        for field in fields(Recipe)
        if getattr(recipe, field.name) != getattr(paper(), field.name)
    } - {"name"}


def test_recipes_are_listed_by_their_names() -> None:
    assert list(RECIPES) == [
        "paper",
        "paper_384",
        "constant_alpha",
        "no_restart",
        "alpha_zero",
        "smoke",
        "builtin",
        "best",
        "finetune",
        "pvda_unlabelled",
        "instance_loss",
        "lcm_style",
        "lpn",
        "lpn_pvda_rates",
        "usam",
        "usam_lpn",
        "pcl_style",
        "msba_style",
        "fsra",
        "fsra_3",
        "mccg",
        "sample4geo",
        "dac",
        "camp",
        "qdfl",
    ]
    assert all(make().name == name for name, make in RECIPES.items())
    assert all((make.__doc__ or "").splitlines()[0].endswith(".") for make in RECIPES.values())


def test_recipe_paper_384_differs_in_image_size_only() -> None:
    assert differing(paper_384()) == {"network"}
    assert paper_384().network == replace(paper().network, image_size=384)


def test_recipe_lpn_has_no_discriminator_and_120_epochs() -> None:
    recipe = lpn()
    assert not recipe.adversary
    tiny = PVDAConfig(backbone="resnet18", width=0.25, part_dim=8)
    training = Training(tiny, recipe.optimization, 3, adversary=recipe.adversary)
    assert list(training.learning_rates) == ["backbone", "head", "classifier"]
    rates = recipe.optimization
    assert (rates.optimizer, rates.backbone_lr, rates.head_lr, rates.classifier_lr) == (
        "sgd",
        0.0001,
        0.001,
        0.001,
    )
    assert recipe.schedule.epochs == 120
    scales = [schedule_at(recipe.schedule, epoch).lr_scale for epoch in range(120)]
    assert scales == pytest.approx([1.0] * 80 + [0.1] * 40)
    assert differing(recipe) == {"schedule", "adversary", "optimization"}
    assert differing(lpn_pvda_rates()) == {"schedule", "adversary"}


def test_recipe_constant_alpha_keeps_alpha_and_restarts() -> None:
    schedule = constant_alpha().schedule
    assert differing(constant_alpha()) == {"schedule"}
    assert {schedule_at(schedule, epoch).alpha for epoch in range(560)} == {0.9}
    assert [schedule_at(schedule, epoch).lr_scale for epoch in range(560)] == [
        schedule_at(paper().schedule, epoch).lr_scale for epoch in range(560)
    ]


def test_recipe_no_restart_grows_alpha_and_lowers_rates() -> None:
    schedule = no_restart().schedule
    assert differing(no_restart()) == {"schedule"}
    for epoch in range(560):
        assert schedule_at(schedule, epoch).alpha == schedule_at(paper().schedule, epoch).alpha
        assert schedule_at(schedule, epoch).lr_scale == pytest.approx(0.8 ** (epoch // 140))


def test_recipe_alpha_zero_is_paper_with_alpha_zero() -> None:
    schedule = alpha_zero().schedule
    assert differing(alpha_zero()) == {"schedule"}
    assert alpha_zero().adversary
    for epoch in range(560):
        assert schedule_at(schedule, epoch).alpha == 0
        assert (
            schedule_at(schedule, epoch).lr_scale == schedule_at(paper().schedule, epoch).lr_scale
        )


@pytest.mark.parametrize("name", RECIPES)
def test_config_table_shows_every_setting(name: str) -> None:
    recipe = RECIPES[name]()
    text = shown(recipe, shards="s3://bucket/shards", weights=None)
    for part in (recipe, recipe.network, recipe.optimization, recipe.schedule, recipe.augmentation):
        for field in fields(part):
            value = getattr(part, field.name)
            assert hasattr(value, "__dataclass_fields__") or f"{field.name}={value}" in text
    assert f"recipe {name}, as it is" in text
    assert "shards=s3://bucket/shards" in text
    assert "weights=None" in text
    assert "*" not in text


def test_config_table_marks_changed_settings() -> None:
    recipe = paper()
    changed = replace(recipe, batch_size=2, network=replace(recipe.network, image_size=128))
    text = shown(changed)
    assert "recipe paper, 2 changed (*)" in text
    assert "*image_size=128 (not 256)" in text
    assert "*batch_size=2 (not 8)" in text
    assert text.count("*") == 3  # in the title, and one each
    assert "*epochs=3 (not 80)" in shown(smoke(epochs=3))


def test_config_table_of_unknown_recipe_marks_nothing() -> None:
    text = shown(replace(paper(), name="mine", batch_size=2))
    assert "recipe mine, none of the named ones" in text
    assert "batch_size=2" in text
    assert "*" not in text


def test_config_table_fits_the_screen_on_stderr(
    capsys: pytest.CaptureFixture[str],
) -> None:
    print_config(paper(), shards="/data/" + "deep/" * 40)
    said = capsys.readouterr()
    assert said.out == ""
    assert "image_size=256" in said.err
    assert max(map(len, said.err.splitlines())) <= 80


def test_recipe_paper_starts_from_torchvision_resnet50(
    tmp_path: Path, tiny_shards: str, prepared: Launcher
) -> None:
    """Two real steps by command line, on small images and a narrow D; the backbone has all its
    layers at full width.
    """
    torch.manual_seed(5)
    # As trained residual blocks do, each adds a little; at random they would add so much that one
    # step throws conv1 far off.
    given = {
        name: tensor / 5 if name.endswith("bn3.weight") else tensor
        for name, tensor in ResNet("resnet50").state_dict().items()
    }
    torch.save(
        given | {"fc.weight": torch.zeros(1000, 2048), "fc.bias": torch.zeros(1000)},
        tmp_path / "resnet50.pth",
    )
    small = [
        "--image-size",
        "128",
        "--batch-size",
        "3",
        "--epochs",
        "1",
        "--discriminator-channels",
        "64",
    ]
    paths = [
        "--shards",
        tiny_shards,
        "--out",
        str(tmp_path / "run"),
        "--weights",
        str(tmp_path / "resnet50.pth"),
    ]
    ended = prepared.start("train", ["paper", *paths, *small, "--workers", "0"]).end()
    assert ended.code == 0, ended.output
    assert "recipe paper, 4 changed (*)" in ended.output
    assert "*image_size=128 (not 256)" in ended.output
    checkpoint = loads((tmp_path / "run" / "last.pt").read_bytes())
    shutil.rmtree(tmp_path / "run")  # hundreds of megabytes, which pytest would keep
    assert (checkpoint.network.backbone, checkpoint.network.width, checkpoint.network.parts) == (
        "resnet50",
        1.0,
        4,
    )
    assert (checkpoint.recipe["name"], checkpoint.recipe["batch_size"]) == ("paper", 3)
    assert (checkpoint.history[0]["step"], checkpoint.history[0]["alpha"]) == (2, 0.9)
    assert all(
        math.isfinite(checkpoint.history[0][f"{loss}_loss"])
        for loss in ("location", "view", "adversarial")
    )
    for name in ("conv1.weight", "layer4.2.conv3.weight"):
        now, before = checkpoint.encoder_weights[f"backbone.{name}"], given[name]
        assert not torch.equal(now, before)
        assert (
            torch.cosine_similarity(now.flatten(), before.flatten(), dim=0) > 0.9
        )  # it started from there


def test_recipe_repeats_pairs_only_where_they_are_paired() -> None:
    recipe = replace(paper(), sampler="paired", pair_repeats=3)
    with pytest.raises(InputError, match="--pair-repeats 3 with --sampler independent"):
        replace(recipe, sampler="independent")
    with pytest.raises(InputError, match="--pair-repeats is 0, expected 1 or more"):
        replace(recipe, pair_repeats=0)


def test_recipe_with_info_nce_needs_distinct_locations() -> None:
    recipe = replace(paper(), sampler="paired", losses=LossWeights(contrastive_weight=1.0))
    assert recipe.pair_repeats == 1
    with pytest.raises(InputError, match="--sampler is 'paired', expected unique_pairs"):
        replace(recipe, pair_repeats=2)
