"""The benchmark of methods: equal terms for all, a leaderboard that resumes."""

import json
from dataclasses import fields, replace
from pathlib import Path

import pytest

from jobs.stages.benchmark import benchmark, cost_of
from jobs.stages.benchmark_settings import METHODS, BenchmarkSettings
from jobs.training.equal_budget import at_equal_budget
from jobs.training.recipes import RECIPES
from jobs.training.recipes.recipe import Recipe
from model.checkpoint import Checkpoint, dumps
from model.pvda import FeatureEncoder
from pipeline.core.errors import InputError

pytestmark = pytest.mark.slow

SAME = ("start", "optimization", "augmentation", "batch_size", "joint_bn", "pair_repeats", "seed")
OWN = ("losses", "sampler", "adversary")


def test_equal_budget_keeps_ingredients_and_no_more() -> None:
    shrunk = {name: at_equal_budget(RECIPES[name](), 20, 3) for name in METHODS}
    assert {field.name for field in fields(Recipe)} >= {*SAME, *OWN}
    for name, recipe in shrunk.items():
        published = RECIPES[name]()
        assert all(getattr(recipe, own) == getattr(published, own) for own in OWN)
        assert recipe.network.pooling == published.network.pooling
        assert recipe.network.neck == published.network.neck
        assert recipe.schedule.epochs == 20
    terms = {tuple(str(getattr(recipe, same)) for same in SAME) for recipe in shrunk.values()}
    assert len(terms) == 1
    assert {name: recipe.network.backbone for name, recipe in shrunk.items()} == dict.fromkeys(
        METHODS, "efficientnet_lite0"
    ) | dict.fromkeys(("usam", "usam_lpn"), "efficientnet_lite0_usam")
    assert shrunk["paper"].schedule.period == 5
    assert shrunk["lpn"].schedule.decay_epochs == (13,)
    assert shrunk["sample4geo"].network.part_dim == 1280


@pytest.mark.parametrize("method", ["qdfl", "usam"])
def test_cost_of_encoders_with_attention(method: str, tmp_path: Path) -> None:
    """Learnt queries ask for gradients, which torch's counter of operations stumbles over."""
    network = replace(at_equal_budget(RECIPES[method](), 1, 0).network, image_size=64)
    encoder = FeatureEncoder(network)
    made = Checkpoint(
        network=network, recipe={}, locations=[], epoch=0, history=[],
        state={"modules": {"encoder": encoder.state_dict()}},
    )  # fmt: skip
    (tmp_path / "last.pt").write_bytes(dumps(made))
    cost = cost_of(str(tmp_path / "last.pt"))
    assert cost.parameters == sum(parameter.numel() for parameter in encoder.parameters())
    assert 0.01 < cost.gmac < 1


@pytest.mark.parametrize("methods", [("lpn",), ("lpn", "lpn"), ("lpn", "street")])
def test_benchmark_refuses_methods_it_cannot_compare(methods: tuple[str, ...]) -> None:
    with pytest.raises(InputError, match=r"--methods is lpn.*expected two or more different"):
        BenchmarkSettings(methods=methods)


def test_benchmark_writes_leaderboard_and_keeps_finished_runs(
    tmp_path: Path, ray_cluster: None, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = BenchmarkSettings(
        out=str(tmp_path),
        methods=("instance_loss", "sample4geo"),
        budget=1,
        train_locations=24,
        test_locations=3,
        distractors=1,
        views=2,
        size=64,
    )
    page = Path(benchmark(settings))
    rows = json.loads((tmp_path / "leaderboard.json").read_text())
    assert [row["method"] for row in rows] == ["instance_loss", "sample4geo"]
    [baseline, other] = [row["tasks"][0] for row in rows]
    assert baseline["difference"] is None
    assert other["difference"]["mean"] == pytest.approx(other["r1"] - baseline["r1"])
    assert rows[1]["cost"]["numbers"] == 1280
    assert 0 < rows[0]["cost"]["gmac"] < 1
    text = page.read_text()
    assert "sample4geo" in text
    assert "without distractors" in text  # Sample4Geo's published row
    assert "figure 3" in text
    assert "Cosine of true pairs" in text
    assert text.count('<article class="panel"') >= 4
    assert text.count("data:image/webp;base64,") >= 10
    assert "| instance_loss | 1 |" in (tmp_path / "leaderboard.md").read_text()
    trained = (tmp_path / "runs/instance_loss-seed0/last.pt").stat().st_mtime_ns
    capsys.readouterr()
    assert benchmark(settings) == str(page)
    assert (tmp_path / "runs/instance_loss-seed0/last.pt").stat().st_mtime_ns == trained
