"""Training without labels: rounds of pseudo-pairs, on after a kill, blind to the labels."""

import io
import json
import shutil
import tarfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import torch

from jobs.command_line.cli import parse
from jobs.train import main
from jobs.training.driver import train
from jobs.training.recipes.pvda_unlabelled import pvda_unlabelled
from jobs.training.recipes.recipe import Recipe
from jobs.training.rounds import labels_file
from jobs.training.settings import RECIPE
from model.checkpoint import loads
from model.config import LossWeights
from model.training import Training
from pipeline.core import parquet
from pipeline.core.errors import InputError
from tests.jobs.tiny_runs import rows, settings, tiny, weights

pytestmark = pytest.mark.slow


def unlabelled(**changes: Any) -> Recipe:
    """Two rounds of two epochs, three steps each."""
    recipe = tiny(4)
    given: dict[str, Any] = {
        "losses": LossWeights(location_weight=0.0, contrastive_weight=1.0),
        "schedule": replace(recipe.schedule, period=2, alpha_step=0.1),
        "sampler": "unique_pairs",
        "pseudo_neighbours": 6,
    }
    return replace(recipe, **given | changes)


def pairs(out: Path, number: int) -> dict[str, str]:
    table = parquet.read_table(labels_file(str(out), number))
    return dict(zip(table["drone"].to_pylist(), table["satellite"].to_pylist(), strict=True))


@pytest.fixture(scope="module")
def undisturbed(tiny_shards: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("unlabelled")
    train(settings(tiny_shards, out, unlabelled()))
    return out


def assert_same_weights(one: Path, other: Path) -> None:
    first, second = weights(one), weights(other)
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_round_pairs_the_views_and_raises_alpha(undisturbed: Path) -> None:
    checkpoint = loads((undisturbed / "last.pt").read_bytes())
    assert [row["alpha"] for row in rows(undisturbed)] == pytest.approx([0.1, 0.1, 0.2, 0.2])
    assert sorted(checkpoint.locations)[0].startswith("train-satellite-")
    for number in (1, 2):
        made = pairs(undisturbed, number)
        assert set(made.values()) <= set(checkpoint.locations)
        row = rows(undisturbed)[2 * number - 1]
        assert row["pseudo_labels/drone"] == pytest.approx(len(made) / 18)
        assert row["pseudo_labels/satellite"] == pytest.approx(len(set(made.values())) / 6)


class Killed(BaseException):
    pass


@pytest.mark.parametrize("step", [6, 8])
def test_killed_run_goes_on_with_the_rounds_pairs(
    step: int,
    tiny_shards: str,
    tmp_path: Path,
    undisturbed: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Between the rounds, and within the second, whose file was lost."""
    real, left = Training.step, iter(range(step))

    def mortal(self: Training, *arguments: Any) -> Any:
        if next(left, None) is None:
            raise Killed
        return real(self, *arguments)

    monkeypatch.setattr(Training, "step", mortal)
    with pytest.raises(Killed):
        train(settings(tiny_shards, tmp_path, unlabelled()))
    monkeypatch.undo()
    Path(labels_file(str(tmp_path), 2)).unlink()
    train(settings(tiny_shards, tmp_path, unlabelled()))
    assert_same_weights(tmp_path, undisturbed)
    assert pairs(tmp_path, 2) == pairs(undisturbed, 2)


def permute_labels(folder: Path, shards: str) -> None:
    """A copy of the shards in which every UAV image has another image's location."""
    shutil.copytree(shards, folder)
    records = sorted((folder / "records").glob("train-drone-*.parquet"))
    named = {
        row["key"]: row["location"]
        for path in records
        for row in parquet.read_table(str(path)).to_pylist()
    }
    order = np.random.default_rng(0).permutation(len(named))
    given = dict(zip(named, np.array(list(named.values()))[order].tolist(), strict=True))
    assert any(given[key] != named[key] for key in named)
    for path in records:
        table = parquet.read_table(str(path))
        column = pa.array([given[key] for key in table["key"].to_pylist()])
        at = table.schema.get_field_index("location")
        parquet.write_table(str(path), table.set_column(at, table.schema.field(at), column))
        tar = folder / f"{path.stem}.tar"
        with tarfile.open(tar) as opened:
            members = [(one, opened.extractfile(one).read()) for one in opened]  # type: ignore
        with tarfile.open(tar, "w") as written:
            for member, data in members:
                if member.name.endswith(".json"):
                    stated = json.loads(data)
                    data = json.dumps(stated | {"location": given[stated["key"]]}).encode()
                member.size = len(data)
                written.addfile(member, io.BytesIO(data))


def test_labels_of_the_shards_change_nothing(
    tiny_shards: str, tmp_path: Path, undisturbed: Path
) -> None:
    permute_labels(tmp_path / "shards", tiny_shards)
    train(settings(str(tmp_path / "shards"), tmp_path / "run", unlabelled()))
    assert_same_weights(tmp_path / "run", undisturbed)


def test_too_few_pairs_are_refused(tiny_shards: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"finds pairs for \d of 6 satellite images .* at least 2"):
        train(settings(tiny_shards, tmp_path, unlabelled(pseudo_margin=1.9)))


@pytest.mark.parametrize("changes", [{"hold_out": 0.5}, {"sampler": "paired"}])
def test_recipe_refuses_what_needs_labels(changes: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="pseudo"):
        unlabelled(**changes)


def test_recipe_is_a_word_of_the_command_line() -> None:
    words = ["pvda_unlabelled", "--shards", "s", "--out", "o", "--no-adversary"]
    found = parse(main, words, RECIPE, None)
    assert found is not None
    assert found["settings"].recipe == replace(pvda_unlabelled(), adversary=False)
