"""Every compared method trains: its network at its published size, its losses and its sampler."""

from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch

from jobs.training.driver import train
from jobs.training.recipes import RECIPES
from jobs.training.recipes.recipe import Recipe
from model.backbones.vit import FSRAViT
from model.checkpoint import build_encoder, loads
from model.config import LossWeights
from model.inference.embed import embed
from model.schedule import schedule_at
from model.training import Training
from tests.jobs.tiny_runs import settings

pytestmark = pytest.mark.slow

METHODS = (
    "instance_loss", "lcm_style", "lpn", "usam", "usam_lpn", "pcl_style", "msba_style", "fsra",
    "mccg", "sample4geo", "dac", "camp", "qdfl",
)  # fmt: skip
LOSSES = {
    "msba_style": {"kl_loss"},
    "fsra": {"triplet_loss"},
    "mccg": {"triplet_loss"},
    "sample4geo": {"contrastive_loss"},
    "dac": {"contrastive_loss", "alignment_loss", "gates_loss"},
    "camp": {"contrastive_loss", "regions_loss"},
    "qdfl": {"similarity_loss", "js_loss"},
}
"Besides the location loss."


def small(recipe: Recipe) -> Recipe:
    """The published network on the smallest images that it can divide, two images a view."""
    side = 64 if recipe.network.pooling == "mean" and recipe.sampler == "independent" else 128
    side = 112 if "dinov2" in recipe.network.backbone else side  # patches of 14
    return replace(recipe, network=replace(recipe.network, image_size=side), batch_size=2)


@pytest.mark.parametrize("name", METHODS)
def test_method_takes_a_step_at_its_published_size(name: str) -> None:
    recipe = small(RECIPES[name]())
    torch.manual_seed(0)
    training = Training(
        recipe.network, recipe.optimization, 2, losses=recipe.losses, adversary=recipe.adversary
    )
    before = {key: value.clone() for key, value in training.model.state_dict().items()}
    size = recipe.network.image_size
    images_B3HW = torch.randint(0, 256, (4, 3, size, size), dtype=torch.uint8)
    labels_B = torch.arange(2)
    now = schedule_at(recipe.schedule, recipe.schedule.epochs / 2)
    measures = training.step(images_B3HW[:2], labels_B, images_B3HW[2:], labels_B, now)
    assert all(bool(value.isfinite()) for value in measures.values())
    losses = {key for key in measures if key.endswith("_loss")}
    assert losses == {"location_loss"} | LOSSES.get(name, set())
    moved = [
        key
        for key, value in training.model.encoder.named_parameters()
        if value.requires_grad and not torch.equal(value, before[f"encoder.{key}"])
    ]
    trained = [
        key for key, value in training.model.encoder.named_parameters() if value.requires_grad
    ]
    assert len(moved) >= 0.9 * len(trained)


def test_fsra_trains_from_its_public_weights(tmp_path: Path, tiny_shards: str) -> None:
    torch.manual_seed(1)
    public = FSRAViT().state_dict()
    names = {"embed.proj": "patch_embed.proj", "embed.": ""}
    state = {}
    for key, tensor in public.items():
        for ours, theirs in names.items():
            if key.startswith(ours):
                key = theirs + key.removeprefix(ours)
                break
        state[key] = tensor
    state["pos_embed"] = torch.randn(1, 197, 768)
    torch.save(state | {"head.weight": torch.zeros(1000, 768)}, tmp_path / "vit.pth")
    recipe = RECIPES["fsra"]()
    recipe = replace(
        recipe,
        network=replace(recipe.network, image_size=64),
        schedule=replace(recipe.schedule, epochs=1),
        batch_size=2,
    )
    given = settings(
        tiny_shards, tmp_path / "run", recipe, weights=str(tmp_path / "vit.pth"),
        checkpoint_minutes=60.0,
    )  # fmt: skip
    path = train(given)
    trained = loads(Path(path).read_bytes())
    assert trained.history[0]["triplet_loss"] >= 0
    encoder = build_encoder(trained)
    unit_BE = embed(encoder, torch.zeros(2, 3, 64, 64, dtype=torch.uint8))
    assert unit_BE.shape == (2, 4 * 512)
    key = "backbone.blocks.0.attn.proj.weight"
    change = (encoder.state_dict()[key] - public["blocks.0.attn.proj.weight"]).abs().max()
    assert 0 < float(change) < 0.05


def test_adversary_joins_any_method() -> None:
    recipe = replace(small(RECIPES["sample4geo"]()), adversary=True)
    network = replace(
        recipe.network, backbone="resnet18", width=0.25, part_dim=128, discriminator_channels=16
    )
    training = Training(network, recipe.optimization, 2, losses=recipe.losses, adversary=True)
    images_B3HW = torch.randint(0, 256, (2, 3, 128, 128), dtype=torch.uint8)
    labels_B = torch.arange(2)
    now = replace(schedule_at(recipe.schedule, 1.0), alpha=0.5)
    measures = training.step(images_B3HW, labels_B, images_B3HW, labels_B, now)
    assert {"contrastive_loss", "adversarial_loss", "view_loss"} <= measures.keys()
    names = [group["name"] for one in training.optimizers for group in one.param_groups]
    assert names == ["backbone", "head", "classifier", "objective", "discriminator"]
    state = training.state_dict()
    assert set(state["modules"]) == {"encoder", "classifier", "objective", "discriminator"}
    training.load_state_dict(state)


def test_all_losses_at_once_in_bfloat16() -> None:
    recipe = RECIPES["smoke"]()
    network = replace(
        recipe.network, part_dim=8, image_size=128, discriminator_channels=8, neck="linear_ones"
    )
    weights = {field.name: 0.5 for field in fields(LossWeights) if field.name.endswith("_weight")}
    losses = replace(LossWeights(learn_temperature=True), **weights)  # type: ignore[arg-type]
    training = Training(network, recipe.optimization, 2, losses=losses, precision="bfloat16")
    images_B3HW = torch.randint(0, 256, (4, 3, 128, 128), dtype=torch.uint8)
    labels_B = torch.arange(2)
    now = schedule_at(recipe.schedule, 9.0)
    measures = training.step(images_B3HW[:2], labels_B, images_B3HW[2:], labels_B, now)
    names = {name.replace("_weight", "_loss") for name in weights}
    assert names <= measures.keys()
    assert all(bool(value.isfinite()) for value in measures.values())
    parameters = training.objective.named_parameters()
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for _, p in parameters)


def test_clip_value_bounds_every_gradient() -> None:
    recipe = RECIPES["smoke"]()
    network = replace(recipe.network, part_dim=8, discriminator_channels=8)
    rates = replace(recipe.optimization, clip_value=1e-9, optimizer="sgd", momentum=0.9)
    training = Training(network, rates, 2, adversary=False)
    images_B3HW = torch.randint(0, 256, (2, 3, 64, 64), dtype=torch.uint8)
    labels_B = torch.arange(2)
    training.step(images_B3HW, labels_B, images_B3HW, labels_B, schedule_at(recipe.schedule, 9.0))
    gradients = [p.grad for p in training.model.parameters() if p.grad is not None]
    assert 0 < max(float(grad.abs().max()) for grad in gradients) <= 1e-9 * 1.001
