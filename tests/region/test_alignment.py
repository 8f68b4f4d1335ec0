"""An encoder aligned with photos of which no place is known, and which encoder a region keeps."""

from dataclasses import replace
from pathlib import Path

import pytest

from jobs.region import alignment, tuning
from jobs.region.alignment import align
from jobs.region.folder import Region
from jobs.region.settings import AdaptSettings
from jobs.region.tuning import choose_encoder
from jobs.training.recipes.pvda_unlabelled import pvda_unlabelled
from jobs.training.recipes.recipe import Recipe
from model.weights.builtin import BUILTIN
from pipeline.core.records import Split, View
from pipeline.shards.shard_set import open_shards


def small_recipe() -> Recipe:
    return replace(pvda_unlabelled(rounds=1, round_epochs=1), batch_size=2, pseudo_neighbours=20)


def test_align_trains_on_tiles_and_photos_without_labels(
    adapted_region: AdaptSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(alignment, "LEAST_PHOTOS", 4)
    monkeypatch.setattr(alignment, "MOST_PHOTOS", 6)
    monkeypatch.setattr(alignment, "pvda_unlabelled", small_recipe)
    photos = Path(adapted_region.out) / "flights" / "check" / "photos"
    region, settings = Region(out=str(tmp_path)), replace(adapted_region, photos=str(photos))
    aligned = align(region, settings, BUILTIN)
    assert aligned is not None
    assert Path(aligned).exists()
    views = open_shards(region.path("views")).manifest
    drones, satellites = (
        sum(shard.samples for shard in views.of(Split.TRAIN, view))
        for view in (View.DRONE, View.SATELLITE)
    )
    assert drones == 6
    assert satellites == 8 * 8  # tiles of 55 m side by side on 400 m, the last ones moved back
    assert align(region, settings, BUILTIN) == aligned


def test_align_needs_photos(
    adapted_region: AdaptSettings, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    region = Region(out=str(tmp_path))
    assert align(region, adapted_region, BUILTIN) is None
    photos = Path(adapted_region.out) / "flights" / "check" / "photos"
    assert align(region, replace(adapted_region, photos=str(photos)), BUILTIN) is None
    assert "20 photos set the camera; from 96 on" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("ap", "kept"),
    [
        ({"built-in": 0.4, "tuned": 0.5, "aligned": 0.6}, "aligned"),
        ({"built-in": 0.4, "tuned": 0.5, "aligned": 0.49}, "tuned"),
        ({"built-in": 0.4, "tuned": 0.3, "aligned": 0.4}, "aligned"),
        ({"built-in": 0.4, "tuned": 0.3, "aligned": 0.39}, BUILTIN),
    ],
)
def test_region_keeps_the_encoder_that_ranks_best(
    ap: dict[str, float], kept: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exported, started = list[str](), list[str]()

    def aligned(region: Region, settings: AdaptSettings, start: str) -> str:
        started.append(start)
        return "aligned"

    monkeypatch.setattr(tuning, "pack_pairs", lambda flight: flight)
    monkeypatch.setattr(tuning, "tune", lambda region, minutes, learn: "tuned")
    monkeypatch.setattr(tuning, "align", aligned)
    monkeypatch.setattr(tuning, "_held_out_ap", lambda region, test, name, checkpoint: ap[name])
    monkeypatch.setattr(tuning, "export_weights", lambda one: exported.append(one.checkpoint))
    settings = AdaptSettings(mosaic="map.tif", out=str(tmp_path))
    choose_encoder(Region(out=str(tmp_path)), settings, "learn", "choose")
    assert exported == [kept]
    assert started == ["tuned" if ap["tuned"] >= ap["built-in"] else BUILTIN]
