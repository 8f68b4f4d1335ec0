"""PCL's GAN: its sizes, its steps, a stage that resumes, and shards that pcl_style trains on."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from jobs.training.driver import train
from jobs.training.recipes import RECIPES
from jobs.translation import stage
from jobs.translation.settings import TranslateSettings
from jobs.translation.stage import translate
from model.checkpoint import loads
from model.translation import PatchDiscriminator, TranslationConfig, TranslationTraining, UNet
from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.images.decode import decode
from pipeline.shards.shard_set import open_shards
from tests.jobs.tiny_runs import settings

pytestmark = pytest.mark.slow

SMALL = TranslationConfig(side=32, channels=4)


def test_networks_have_the_published_shapes() -> None:
    with torch.device("meta"):
        generator, judge = UNet(TranslationConfig()), PatchDiscriminator(TranslationConfig())
        image = torch.zeros(2, 3, 256, 256)
        assert generator(image).shape == image.shape
        assert judge(image, image).shape == (2, 1, 30, 30)  # patches of 70 x 70
    # pix2pix's own counts, without biases before BatchNorm.
    assert sum(one.numel() for one in generator.parameters()) == 54_413_955
    assert sum(one.numel() for one in judge.parameters()) == 2_768_705


def test_steps_bring_the_generator_to_its_target() -> None:
    torch.manual_seed(0)
    training = TranslationTraining(replace(SMALL, channels=8, rate=2e-3))
    drone = torch.randint(0, 256, (4, 3, 4, 4), dtype=torch.uint8)
    drone = drone.repeat_interleave(8, 2).repeat_interleave(8, 3)
    satellite = 255 - drone
    losses = [training.step(drone, satellite, 1.0) for _ in range(100)]
    assert losses[-1]["l1"] < 0.35 * losses[0]["l1"]
    assert all(value >= 0 for row in losses for value in row.values())
    made = training.translate(drone)
    assert (made.shape, made.dtype) == (drone.shape, torch.uint8)
    assert torch.equal(made, training.translate(drone))
    assert (made.float() - satellite.float()).abs().mean() < 20
    again = TranslationTraining(training.config)
    again.load_state_dict(training.state_dict())
    assert torch.equal(made, again.translate(drone))


@pytest.mark.parametrize("side", [16, 48])
def test_sides_that_do_not_halve_are_refused(side: int) -> None:
    with pytest.raises(ValueError, match=f"side is {side}, expected a power of 2"):
        TranslationConfig(side=side)
    with pytest.raises(InputError, match=f"--side is {side}, expected a power of 2"):
        TranslateSettings(shards="a", out="b", side=side)


def test_translated_shards_train_pcl_style(tiny_shards: str, tmp_path: Path) -> None:
    given = TranslateSettings(
        shards=tiny_shards, out=str(tmp_path), epochs=20, batch_size=3, side=32, channels=8
    )
    out = translate(given)
    old, new = open_shards(tiny_shards), open_shards(out)
    assert new.manifest.classes == old.manifest.classes
    for split in Split:
        for view in (View.DRONE, View.SATELLITE):
            was, now = (
                {sample.key: sample.data for shard in one.manifest.of(split, view)
                 for sample in one.samples(shard)}
                for one in (old, new)
            )  # fmt: skip
            assert was.keys() == now.keys()
            kept = [was[key] == now[key] for key in was]
            assert all(kept) if view == View.SATELLITE else not any(kept)
            assert view == View.SATELLITE or decode(next(iter(now.values()))).shape == (32, 32, 3)
    generator = tmp_path / "generator.pt"
    before = generator.stat().st_mtime_ns
    assert translate(given) == out
    assert generator.stat().st_mtime_ns == before
    with pytest.raises(InputError, match="is of another translation, expected the same shards"):
        translate(replace(given, seed=1))
    recipe = RECIPES["pcl_style"]()
    network = replace(
        recipe.network, backbone="resnet18", width=0.25, image_size=64, parts=2, part_dim=16
    )
    recipe = replace(
        recipe, network=network, batch_size=2, schedule=replace(recipe.schedule, epochs=1)
    )
    trained = loads(Path(train(settings(out, tmp_path / "run", recipe))).read_bytes())
    assert trained.history[0]["location_loss"] > 0
    assert trained.recipe["perspective"] == "overhead"


def test_translation_resumes_after_its_last_epoch(
    tiny_shards: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(out: str, epochs: int) -> TranslateSettings:
        return TranslateSettings(
            shards=tiny_shards, out=str(tmp_path / out), epochs=epochs, batch_size=2, side=32,
            channels=4,
        )  # fmt: skip

    shards, save = open_shards(tiny_shards), stage._save
    whole = stage.train_generator(run("whole", 2), shards).state_dict()["generator"]

    def save_and_stop(*given: Any) -> None:
        save(*given)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(stage, "_save", save_and_stop)
        with pytest.raises(KeyboardInterrupt):
            stage.train_generator(run("cut", 2), shards)
    resumed = stage.train_generator(run("cut", 2), shards).state_dict()["generator"]
    assert all(torch.equal(whole[name], resumed[name]) for name in whole)
