"""From a map to a localizer: every stage once on a small map, a rerun that makes nothing anew, and
what is refused."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jobs.encoding.localizer import with_localizer
from jobs.region.adapt import PAGE, adapt
from jobs.region.settings import AdaptSettings
from jobs.stages.settings import LocateSettings
from model.weights.builtin import BUILTIN
from pipeline.core.errors import InputError


def test_adapt_makes_a_localizer_and_says_what_to_expect(adapted_region: AdaptSettings) -> None:
    out = Path(adapted_region.out)
    assert "What to expect of map.tif" in (out / PAGE).read_text()
    figures = json.loads((out / "expect" / "figures.json").read_text())
    assert [one["photos"] for one in figures["expectations"][:2]] == [20, 20]
    errors = np.array([one["error_m"] for one in figures["outcomes"] if one["known"]])
    assert np.median(errors) < 25
    assert (out / "index" / "calibration.json").exists()
    located = with_localizer(
        LocateSettings(photos=("a.jpg",), index=str(out / "index"), out="where.geojson")
    )
    assert Path(located.checkpoint).resolve() == (out / "encoder.safetensors").resolve()
    assert Path(located.shards or "").resolve() == (out / "tiles").resolve()
    named = with_localizer(replace(located, checkpoint="mine.pt", shards="tiles"))
    assert (named.checkpoint, named.shards) == ("mine.pt", "tiles")
    (out / "index" / "localizer.json").rename(out / "elsewhere.json")
    alone = LocateSettings(photos=("a.jpg",), index=str(out / "index"), out="where.geojson")
    assert with_localizer(alone).checkpoint == BUILTIN
    (out / "elsewhere.json").rename(out / "index" / "localizer.json")


def test_adapt_again_makes_nothing_anew(adapted_region: AdaptSettings) -> None:
    made = [path for path in Path(adapted_region.out).rglob("*") if path.is_file()]
    kept = {path: path.stat().st_mtime_ns for path in made}
    adapt(adapted_region)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    with pytest.raises(InputError, match="adapted with another seed"):
        adapt(replace(adapted_region, seed=1))


def test_adapt_without_a_map_is_refused(tmp_path: Path) -> None:
    given = AdaptSettings(mosaic=str(tmp_path / "none.tif"), out=str(tmp_path / "region"))
    with pytest.raises(InputError, match="no map at"):
        adapt(given)
    (tmp_path / "none.tif").write_bytes(b"no map")
    (tmp_path / "region").mkdir()
    (tmp_path / "region" / "mine.txt").write_text("not a region's")
    with pytest.raises(InputError, match="holds files of something else"):
        adapt(given)
    assert not (tmp_path / "region" / "region.json").exists()
