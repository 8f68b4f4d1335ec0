"""Places that the features of a whole map vote for, and answers that need them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.camera.ground import looked_at
from pipeline.core.geo import Circle, haversine_m
from pipeline.core.records import View
from pipeline.index.searcher import Hit
from pipeline.locate.locate import Answer
from pipeline.locate.refined import refine_answer
from pipeline.matching.gate import holds
from pipeline.matching.kept_features import FeatureFile
from pipeline.matching.map_features import MapFeatures, MapSearch, find_map_features
from pipeline.matching.map_windows import MapWindows
from pipeline.matching.photo_features import MatchablePhoto, prepare_photo
from pipeline.matching.refine import refine
from tests.matching.made_maps import PLANE, POSE, MadeMap, error_m, made_map, photo_of, window_of

pytestmark = pytest.mark.slow

SIDE = 1500
"Pixels: 450 m, six windows of a tile's size across."


@pytest.fixture(scope="module")
def made() -> MadeMap:
    return MadeMap(SIDE)


@pytest.fixture(scope="module")
def features(made: MadeMap) -> MapFeatures:
    found = find_map_features(made.windows())
    assert found is not None
    return found


@pytest.fixture(scope="module")
def photo(made: MadeMap) -> MatchablePhoto:
    return prepare_photo(photo_of(window_of(made.pixels_HW3)))


def away_m(place: tuple[float, float]) -> float:
    """From the place that the photo shows."""
    [[lat, lon]] = PLANE.to_degrees(np.array([looked_at(POSE)]))
    return float(haversine_m(np.array(place), np.array([lat, lon])))


def test_places_begin_with_the_photo_s(features: MapFeatures, photo: MatchablePhoto) -> None:
    first, *others = features.places(photo, 2)
    assert away_m(first) < 20
    assert all(away_m(place) > features.reach_m for place in others)


def test_places_away_from_the_photo_s_own(features: MapFeatures, photo: MatchablePhoto) -> None:
    here = Circle(lat=PLANE.lat, lon=PLANE.lon, radius_m=150)
    found = features.places(photo, 3, here)
    middle_2 = np.array([PLANE.lat, PLANE.lon])
    # A place is the middle of its votes, of which none lies within.
    assert all(haversine_m(np.array(place), middle_2) > 150 - features.reach_m for place in found)


def test_places_of_a_photo_without_features(features: MapFeatures) -> None:
    assert features.places(prepare_photo(np.full((240, 320, 3), 90, np.uint8)), 2) == []


def test_places_of_another_map_have_few_votes(features: MapFeatures) -> None:
    stranger = prepare_photo(photo_of(window_of(made_map(1))))
    near = [away for away in map(away_m, features.places(stranger, 1)) if away < 20]
    assert near == []


def test_map_features_of_a_sample_or_a_large_map_are_not_made(
    made: MadeMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    sampled = replace(made.gallery, rows=len(made.gallery.keys) + 1)
    assert find_map_features(MapWindows(sampled, made.fetch, made.footprints)) is None
    monkeypatch.setattr("pipeline.matching.map_features.MOST_MAP_WINDOWS", 3)
    assert find_map_features(made.windows()) is None


def test_refine_answer_finds_what_no_candidate_shows(
    made: MadeMap, features: MapFeatures, photo: MatchablePhoto
) -> None:
    """The only candidate lies in a corner of the map."""
    lat, lon = made.gallery.positions_N2[0].tolist()
    hit = Hit(
        key=str(made.gallery.keys[0]),
        location="0",
        view=View.SATELLITE,
        lat=lat,
        lon=lon,
        score=0.5,
    )
    answer = Answer(
        position=None, location=None, probability=None, known=False, candidates=(hit,), agreeing=0
    )
    windows = made.windows()
    alone = refine_answer(answer, photo, windows)
    assert alone is None or not holds(alone)
    windows.search = MapSearch(lambda: None, lambda: features)
    found = refine_answer(answer, photo, windows)
    assert found is not None
    assert holds(found)
    assert error_m(found) < 1
    elsewhere = refine_answer(
        answer, photo, windows, Circle(lat=found.lat, lon=found.lon, radius_m=windows.apart_m(None))
    )
    assert elsewhere is None or not holds(elsewhere)


def test_window_of_kept_features_places_as_its_pixels(
    made: MadeMap, features: MapFeatures, photo: MatchablePhoto
) -> None:
    lat, lon = PLANE.lat, PLANE.lon
    window = features.window(lat, lon, 80)
    assert window is not None
    assert np.abs(window.ground_N2).max() <= 80
    found = refine(photo, [window])
    assert found is not None
    assert holds(found)
    assert error_m(found) < 1
    assert features.window(lat + 1, lon, 80) is None


def test_windows_take_features_that_are_kept(
    made: MadeMap, features: MapFeatures, photo: MatchablePhoto, monkeypatch: pytest.MonkeyPatch
) -> None:
    windows, key = made.windows(), str(made.gallery.keys[0])
    windows.search = MapSearch(lambda: features, lambda: None)
    monkeypatch.setattr(windows, "compose", lambda *_: pytest.fail("reads tiles"))
    [window] = windows.around([(PLANE.lat, PLANE.lon, key)], 1)
    found = refine(photo, [window])
    assert found is not None
    assert error_m(found) < 1


def test_windows_take_features_once_they_are_made(
    made: MadeMap, features: MapFeatures, photo: MatchablePhoto
) -> None:
    search = MapSearch(lambda: None, lambda: features)
    assert search.window(PLANE.lat, PLANE.lon, 80) is None
    search.places(photo, 1)
    assert search.window(PLANE.lat, PLANE.lon, 80) is not None


def test_feature_file_keeps_what_was_made(
    made: MadeMap, photo: MatchablePhoto, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = FeatureFile(path=str(tmp_path / "features.npz"), belongs_to="these tiles")
    assert file.read() is None
    first = file.make(made.windows())
    again = file.read()
    assert first is not None
    assert again is not None
    assert again.places(photo, 2) == first.places(photo, 2)
    other = FeatureFile(path=file.path, belongs_to="other tiles")
    assert other.read() is None
    content = bytearray(Path(file.path).read_bytes())
    content[len(content) // 2] ^= 255
    Path(file.path).write_bytes(bytes(content))
    assert file.read() is None
    monkeypatch.setattr("pipeline.core.storage.write_bytes", _full)
    remade = file.make(made.windows())
    assert remade is not None
    assert remade.places(photo, 2) == first.places(photo, 2)


def _full(path: str, data: bytes) -> None:
    raise OSError(28, "no space left on device", path)
