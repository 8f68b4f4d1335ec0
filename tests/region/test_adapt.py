"""From a map to a localizer: every stage once on a small map, a rerun that makes nothing anew, and
what is refused."""

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import rasterio

from jobs.encoding.localizer import read_localizer, with_localizer
from jobs.region import extend, flights
from jobs.region.adapt import PAGE, adapt
from jobs.region.expect import located_outcomes
from jobs.region.extend import extend_region
from jobs.region.folder import Region
from jobs.region.settings import AdaptSettings
from jobs.stages import calibrate
from jobs.stages.settings import CalibrateSettings, LocateSettings
from model.weights.builtin import BUILTIN
from pipeline.core.errors import InputError
from pipeline.index.searcher import Index
from pipeline.locate.gallery_map import read_gallery_map
from pipeline.shards.manifest import read_manifest
from pipeline.simulation.over_map.settings import TownMapSettings
from pipeline.simulation.over_map.town_map import MAP, SURFACE, make_town_map
from tests.sources.mosaics import mosaic, noise, quarters


def test_adapt_makes_a_localizer_and_says_what_to_expect(adapted_region: AdaptSettings) -> None:
    out = Path(adapted_region.out)
    assert "What to expect of map.tif" in (out / PAGE).read_text()
    figures = json.loads((out / "expect" / "figures.json").read_text())
    assert [one["photos"] for one in figures["expectations"][:2]] == [20, 20]
    errors = np.array([one["error_m"] for one in figures["outcomes"] if one["known"]])
    assert np.median(errors) < 25
    levels = read_gallery_map(Index(str(out / "index"))).level_sides_m
    assert levels == pytest.approx(adapted_region.tile_m, rel=0.02)
    assert (out / "index" / "calibration.json").exists()
    located = with_localizer(
        LocateSettings(photos=("a.jpg",), index=str(out / "index"), out="where.geojson")
    )
    assert Path(located.checkpoint).resolve() == (out / "encoder.safetensors").resolve()
    assert Path(located.shards or "").resolve() == (out / "tiles").resolve()
    assert located.surface == adapted_region.surface
    named = with_localizer(replace(located, checkpoint="mine.pt", shards="tiles"))
    assert (named.checkpoint, named.shards) == ("mine.pt", "tiles")
    (out / "index" / "localizer.json").rename(out / "elsewhere.json")
    alone = LocateSettings(photos=("a.jpg",), index=str(out / "index"), out="where.geojson")
    assert with_localizer(alone).checkpoint == BUILTIN
    (out / "elsewhere.json").rename(out / "index" / "localizer.json")


def test_adapt_again_makes_nothing_anew(adapted_region: AdaptSettings, tmp_path: Path) -> None:
    """Not where the map has been moved, either; one of other bytes is another map."""
    made = [path for path in Path(adapted_region.out).rglob("*") if path.is_file()]
    kept = {path: path.stat().st_mtime_ns for path in made}
    adapt(adapted_region)
    town = Path(shutil.copytree(Path(adapted_region.mosaic).parent, tmp_path / "moved"))
    moved = replace(adapted_region, mosaic=str(town / MAP), surface=str(town / SURFACE))
    adapt(moved)
    for changed in (town / SURFACE, town / MAP):
        data = changed.read_bytes()
        changed.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
        with pytest.raises(InputError, match="adapted with another mosaic, surface, expected"):
            adapt(moved)
        changed.write_bytes(data)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    with pytest.raises(InputError, match="adapted with another seed"):
        adapt(replace(adapted_region, seed=1))


def test_calibrate_with_and_without_heights_are_two(
    adapted_region: AdaptSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = Path(adapted_region.out)
    settings = CalibrateSettings(
        checkpoint=str(out / "encoder.safetensors"), shards=str(out / "tiles"),
        index=str(out / "index"), flight=str(out / "flights" / "check" / "photos.csv"),
        surface=adapted_region.surface,
    )  # fmt: skip
    monkeypatch.setattr(calibrate, "_calibrate_on_flight", lambda *_: pytest.fail("fitted anew"))
    assert calibrate.calibrate_index(settings).matching is not None
    with pytest.raises(pytest.fail.Exception, match="fitted anew"):
        calibrate.calibrate_index(replace(settings, surface=None))


def test_adapt_without_a_map_is_refused(tmp_path: Path) -> None:
    given = AdaptSettings(mosaic=str(tmp_path / "none.tif"), out=str(tmp_path / "region"))
    with pytest.raises(InputError, match="no map at"):
        adapt(given)
    mosaic(tmp_path / "sheets" / "a.tif", noise(3, 8, 8))
    mosaic(tmp_path / "sheets" / "b.tif", noise(1, 8, 8))
    with pytest.raises(InputError, match="in its bands"):
        adapt(replace(given, mosaic=str(tmp_path / "sheets")))
    named = replace(given, mosaic=str(tmp_path / "sheets"), surface=str(tmp_path / "dsm.tif"))
    with pytest.raises(InputError, match=r"no surface model at .*dsm\.tif, expected a GeoTIFF"):
        adapt(named)
    (tmp_path / "none.tif").write_bytes(b"no map")
    (tmp_path / "region").mkdir()
    (tmp_path / "region" / "mine.txt").write_text("not a region's")
    with pytest.raises(InputError, match="holds files of something else"):
        adapt(given)
    assert not (tmp_path / "region" / "region.json").exists()


def test_extend_adds_a_map_once(
    adapted_region: AdaptSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A map of four sheets, and a region that was moved. That the confidence is fitted anew where
    the gallery has grown is in test_calibrate."""
    town = make_town_map(TownMapSettings(out=str(tmp_path / "town"), side=200.0, seed=5))
    with rasterio.open(town / MAP) as opened:
        sheets = quarters(tmp_path / "map", opened.read(), opened.transform, crs=opened.crs)
    out = Path(shutil.copytree(adapted_region.out, tmp_path / "region"))
    hidden = tmp_path / "hidden"
    more = replace(adapted_region, mosaic=sheets, surface=None, out=str(out), extend=True)
    fitted = list[Region]()
    monkeypatch.setattr(extend, "fit_confidence", lambda region, _: fitted.append(region))
    monkeypatch.setattr(flights, "CHECK_PX", 256)
    some = partial(located_outcomes, most=1)
    monkeypatch.setattr(extend, "located_outcomes", lambda *given: some(*given[:3]))
    first = len(Index(str(out / "index")))
    Path(adapted_region.out).rename(hidden)  # so that nothing of it is read
    try:
        found = extend_region(more)
    finally:
        hidden.rename(adapted_region.out)
    assert [one.photos for one in found[:2]] == [2, 2]  # one over each map, each way
    index = Index(str(out / "index"))
    rows = sum(shard.samples for shard in read_manifest(str(out / "tiles")).shards)
    assert len(index) == rows > first
    assert len(fitted) == 1
    assert "What to expect of map.tif and map" in (out / PAGE).read_text()
    noted = read_localizer(str(out / "index"))
    assert noted is not None
    assert noted.surface == adapted_region.surface  # the other map has none
    kept = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    assert extend_region(more)[0].photos == 2
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    with pytest.raises(InputError, match=r"no finished region at .*expected one to extend"):
        extend_region(replace(more, out=str(tmp_path / "none")))
