"""A photo matched with the map's pixels in the service: the answer, and what fails."""

import io

import numpy as np
import pytest
from PIL import Image

from pipeline.core.records import View
from pipeline.images.camera_tags import CameraTags
from pipeline.index.searcher import Hit
from pipeline.locate.locate import Answer, Position
from pipeline.matching.photo_pose import PoseSettings
from pipeline.service.photo_map import GroundPicture, Located, PhotoMap, TilePicture
from pipeline.service.request import NOTHING_KNOWN
from tests.matching.made_maps import (
    POSE,
    SIDE,
    TILE_PX,
    MadeMap,
    error_m,
    made_map,
    photo_of,
    window_of,
)
from tests.service.http_client import Client, FakeEngine, post, run_with_service
from tests.service.photos import photo
from tests.service.test_openapi import validate

pytestmark = pytest.mark.slow

POSE_KNOWN = PoseSettings(fov=55.0, height=60.0, heading=30.0, pitch=-60.0)


class ServedMap(MadeMap):
    """A made map as the service has it."""

    def photo_map(self, match: bool = True) -> PhotoMap:
        return PhotoMap(self.gallery, self.fetch, self.windows(), match)

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
def made() -> ServedMap:
    return ServedMap()


def located(made: ServedMap, known: PoseSettings = NOTHING_KNOWN) -> Located:
    photo_map = made.photo_map()
    framed = photo_map.frame(photo_of(window_of(made_map(0))), CameraTags(), known)
    return photo_map.refine(made.tile_answer(), framed)


@pytest.mark.parametrize("known", [NOTHING_KNOWN, POSE_KNOWN], ids=["alone", "with its pose"])
def test_photo_map_refines_an_answer(made: ServedMap, known: PoseSettings) -> None:
    found = located(made, known)
    assert found.match_error is None
    assert found.match_seconds is not None
    assert found.answer.position is not None
    assert found.answer.position.how == "refined"
    assert found.answer.refinement is not None
    assert error_m(found.answer.refinement) < 1


def test_photo_map_frames_by_what_the_request_knows(made: ServedMap) -> None:
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
    made: ServedMap, monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    def fail(*arguments: object) -> None:
        raise OSError("the disk went away")

    monkeypatch.setattr(f"pipeline.service.photo_map.{part}", fail)
    found = located(made)
    assert found.answer == made.tile_answer()
    assert found.match_error == "OSError: the disk went away"


def test_photo_map_pictures(made: ServedMap) -> None:
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


def test_refined_answer_is_valid_by_its_published_schema(made: ServedMap) -> None:
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
