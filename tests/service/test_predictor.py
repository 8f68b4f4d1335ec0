"""Batches of photos: decoded, seen as the encoder sees them, searched."""

from pathlib import Path

import pytest

from pipeline.camera.overhead import overhead_view
from pipeline.core.arrays import Pixels
from pipeline.core.records import Rejection
from pipeline.images.decode import decode
from pipeline.index.metadata import IndexMetadata
from pipeline.matching.photo_pose import PoseSettings
from pipeline.service.photo_map import Located
from pipeline.service.predictor import Predictor
from pipeline.service.request import LocateRequest
from tests.service.made_index import WidthEncoder, locate_request, make_index
from tests.service.photos import photo


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return make_index(tmp_path / "index", 3)


def test_predictor_batch_is_one_forward_pass(path: Path) -> None:
    predictor = Predictor(str(path), WidthEncoder)
    requests = [
        locate_request(2),
        LocateRequest(photo=photo()[:-40]),
        locate_request(0, top=1),
        locate_request(1),
        locate_request(2, top=1),
    ]
    found = predictor.predict(requests)
    assert isinstance(found[1], Rejection)
    answers = [one.answer for one in found if isinstance(one, Located)]
    assert [one.location for one in answers] == ["place2", "place0", "place1", "place2"]
    assert [len(one.candidates) for one in answers] == [3, 1, 3, 1]
    assert predictor._encoder.batches == [4]  # type: ignore[attr-defined]


def test_predictor_without_calibration_uses_gallery_spacing(path: Path) -> None:
    """Locations are 1,000 m apart: half of it is the radius, as `locate` answers."""
    predictor = Predictor(str(path), WidthEncoder)
    (located,) = predictor.predict([locate_request(1)])
    assert isinstance(located, Located)
    assert located.answer.position is not None
    assert located.answer.position.radius_m == pytest.approx(0.009 / 2 * 111_195, rel=1e-3)


class OverheadEncoder(WidthEncoder):
    """Keeps what it was shown; any photo is location 0."""

    perspective = "overhead"

    def __init__(self, metadata: IndexMetadata | None = None) -> None:
        super().__init__()
        self.shown: list[Pixels] = []

    def to_input(self, image_HW3: Pixels) -> Pixels:
        self.shown.append(image_HW3)
        return image_HW3[:, :16]


def test_predictor_lays_photos_on_the_ground_for_overhead(path: Path) -> None:
    predictor = Predictor(str(path), OverheadEncoder)
    encoder = predictor._encoder
    assert isinstance(encoder, OverheadEncoder)
    known = PoseSettings(heading=90.0, pitch=-60.0, fov=55.0)
    data = photo(size=(64, 48))
    predictor.predict([LocateRequest(photo=data), LocateRequest(photo=data, pose=known)])
    as_taken_HW3, on_ground_HW3 = encoder.shown
    assert (as_taken_HW3 == decode(data)).all()
    pose = {"heading_deg": 90.0, "pitch_deg": -60.0, "fov_deg": 55.0}
    assert (on_ground_HW3 == overhead_view(decode(data), pose)).all()
    assert on_ground_HW3.shape != as_taken_HW3.shape
