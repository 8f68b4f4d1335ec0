"""A photo matched with the map's pixels in the service: the answer, and what fails."""

import io
from collections.abc import Iterable

import numpy as np
import pytest
from PIL import Image

from pipeline.camera.local_plane import LocalPlane
from pipeline.core.records import View
from pipeline.images.camera_tags import CameraTags
from pipeline.index.searcher import Hit
from pipeline.locate.gallery_map import GalleryMap
from pipeline.locate.locate import Answer, Position
from pipeline.matching.map_windows import MapWindows
from pipeline.matching.photo_pose import PoseSettings
from pipeline.service.photo_map import GroundPicture, Located, PhotoMap, TilePicture
from pipeline.service.request import NOTHING_KNOWN
from tests.matching.test_refine import (
    METRES_PER_PIXEL,
    POSE,
    SIDE,
    error_m,
    made_map,
    photo_of,
    window_of,
)
from tests.service.http_client import Client, FakeEngine, post, run_with_service
from tests.service.photos import photo
from tests.service.test_openapi import validate

TILE_PX = 125
PLANE = LocalPlane(lat=47.0, lon=8.0)
POSE_KNOWN = PoseSettings(fov=55.0, height=60.0, heading=30.0, pitch=-60.0)


class MadeMap:
    """Tiles of a made map, by key: PNG files, corners and positions."""

    def __init__(self) -> None:
        image_HW3, half_m = made_map(0), SIDE / 2 * METRES_PER_PIXEL
        self.images: dict[str, bytes] = {}
        self.corners: dict[str, list[list[float]]] = {}
        middles = []
        for row in range(0, SIDE, TILE_PX):
            for column in range(0, SIDE, TILE_PX):
                key = f"gallery-satellite-{row}-{column}"
                stream = io.BytesIO()
                tile_HW3 = image_HW3[row : row + TILE_PX, column : column + TILE_PX]
                Image.fromarray(tile_HW3).save(stream, "PNG")
                self.images[key] = stream.getvalue()
                west, north = column * METRES_PER_PIXEL - half_m, half_m - row * METRES_PER_PIXEL
                east, south = west + TILE_PX * METRES_PER_PIXEL, north - TILE_PX * METRES_PER_PIXEL
                corners = np.array([[west, north], [east, north], [east, south], [west, south]])
                self.corners[key] = PLANE.to_degrees(corners).tolist()
                middles.append(PLANE.to_degrees(corners.mean(axis=0)[None])[0])
        self.gallery = GalleryMap(
            keys=np.array(list(self.images)),
            locations=np.array(list(self.images)),
            positions_N2=np.array(middles),
            rows=len(middles),
        )

    def fetch(self, keys: Iterable[str]) -> dict[str, bytes]:
        return {key: self.images[key] for key in keys if key in self.images}

    def footprints(self, keys: Iterable[str]) -> dict[str, list[list[float]]]:
        return {key: self.corners[key] for key in keys if key in self.corners}

    def photo_map(self, match: bool = True) -> PhotoMap:
        windows = MapWindows(self.gallery, self.fetch, self.footprints)
        return PhotoMap(self.gallery, self.fetch, windows, match)

    def tile_answer(self) -> Answer:
        """The answer of a tile in the middle."""
        lat, lon = self.gallery.positions_N2[10].tolist()
        key = str(self.gallery.keys[10])
        hit = Hit(key=key, location="10", view=View.SATELLITE, lat=lat, lon=lon, score=0.5)
        return Answer(
            position=Position(lat=lat, lon=lon, radius_m=20.0), location="10", probability=None,
            known=True, candidates=(hit,), agreeing=1,
        )  # fmt: skip


@pytest.fixture(scope="module")
def made() -> MadeMap:
    return MadeMap()


def located(made: MadeMap, known: PoseSettings = NOTHING_KNOWN) -> Located:
    photo_map = made.photo_map()
    framed = photo_map.frame(photo_of(window_of(made_map(0))), CameraTags(), known)
    return photo_map.refine(made.tile_answer(), framed)


@pytest.mark.parametrize("known", [NOTHING_KNOWN, POSE_KNOWN], ids=["alone", "with its pose"])
def test_photo_map_refines_an_answer(made: MadeMap, known: PoseSettings) -> None:
    found = located(made, known)
    assert found.match_error is None
    assert found.match_seconds is not None
    assert found.answer.position is not None
    assert found.answer.position.how == "refined"
    assert found.answer.refinement is not None
    assert error_m(found.answer.refinement) < 1


def test_photo_map_frames_by_what_the_request_knows(made: MadeMap) -> None:
    photo_HW3 = photo_of(window_of(made_map(0)))
    photo_map = made.photo_map()
    assert len(photo_map.frame(photo_HW3, CameraTags(), NOTHING_KNOWN).views.images) == 3
    assert photo_map.frame(photo_HW3, CameraTags(), POSE_KNOWN).views.framing == "ground"
    unmatched = made.photo_map(match=False)
    framed = unmatched.frame(photo_HW3, CameraTags(), POSE_KNOWN)
    assert (framed.views.framing, len(framed.views.images)) == ("none", 1)
    assert unmatched.refine(made.tile_answer(), framed).match_seconds is None


@pytest.mark.parametrize("part", ["prepare_photo", "refine_answer"])
def test_photo_map_failure_leaves_the_tiles_answer(
    made: MadeMap, monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    def fail(*arguments: object) -> None:
        raise OSError("the disk went away")

    monkeypatch.setattr(f"pipeline.service.photo_map.{part}", fail)
    found = located(made)
    assert found.answer == made.tile_answer()
    assert found.match_error == "OSError: the disk went away"


def test_photo_map_pictures(made: MadeMap) -> None:
    photo_map = made.photo_map()
    tile = photo_map.picture(TilePicture(key="gallery-satellite-125-250"))
    assert tile is not None
    assert Image.open(io.BytesIO(tile)).size == (TILE_PX, TILE_PX)
    made.images["query-drone-1"] = made.images["gallery-satellite-125-250"]
    assert photo_map.picture(TilePicture(key="query-drone-1")) is None
    assert photo_map.picture(GroundPicture(lat=40.0, lon=8.0, half_m=50.0)) is None
    ground = photo_map.picture(GroundPicture(lat=47.0, lon=8.0, half_m=100.0))
    assert ground is not None
    shown_HW4 = np.asarray(Image.open(io.BytesIO(ground)))
    assert shown_HW4.shape[2] == 4
    assert shown_HW4[:, :, 3].mean() / 255 == pytest.approx(0.75**2, abs=0.02)
    middle_HW3 = shown_HW4[len(shown_HW4) // 2 - 60 :, len(shown_HW4) // 2 - 60 :][:120, :120, :3]
    expected_HW3 = made_map(0)[SIDE // 2 - 60 : SIDE // 2 + 60, SIDE // 2 - 60 : SIDE // 2 + 60]
    assert np.abs(middle_HW3.astype(float) - expected_HW3).mean() < 25


def test_refined_answer_is_valid_by_its_published_schema(made: MadeMap) -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        body = await validate(client, await post(client, photo(), query="?height=60"))
        assert body["position"]["how"] == "refined"
        assert body["position"]["ellipse"]["major_m"] > 0
        refinement = body["refinement"]
        assert len(refinement["footprint"]) == 4
        assert refinement["camera"][2] == pytest.approx(60, abs=3)
        assert refinement["heading_deg"] == pytest.approx(30, abs=1)
        assert 0 < len(refinement["points"]) <= 40 <= refinement["inliers"]
        assert body["match_seconds"] > 0
        assert body["pictures"] == "map"
        assert engine.batches[0][0].pose.height == 60
        text = await (await client.get("/metrics")).text()
        assert 'pvda_answers_total{how="refined"} 1.0' in text
        assert "pvda_match_seconds_count 1.0" in text

    found = located(made, PoseSettings(fov=POSE.fov_deg))
    run_with_service(test, outcome=found)
