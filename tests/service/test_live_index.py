"""An index that is replaced while it is searched: used once complete and valid, else refused."""

import asyncio
import shutil
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from aiohttp.test_utils import TestClient, TestServer

from pipeline.camera.overhead import overhead_view
from pipeline.camera.pose import Perspective
from pipeline.core import json_files
from pipeline.core.arrays import Floats, Pixels
from pipeline.core.errors import InputError
from pipeline.core.records import Rejection
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.images.decode import decode
from pipeline.index.build import build_index
from pipeline.index.metadata import IndexMetadata
from pipeline.index.settings import IndexSettings
from pipeline.matching.photo_pose import PoseSettings
from pipeline.service import live_index
from pipeline.service.app import Service
from pipeline.service.live_index import LiveIndex
from pipeline.service.photo_map import Located, MapOpener, PictureRequest, no_map
from pipeline.service.predictor import Outcome, Predictor, ServiceStatus
from pipeline.service.request import LocateRequest
from pipeline.service.settings import ServiceSettings
from tests.service.photos import photo

DIMENSION = 8


def make_index(path: Path, rows: int, fingerprint: str = "f" * 64) -> Path:
    """An index of `rows` locations 1,000 m apart; the embedding of location n is the n-th unit
    vector."""
    table = path.with_name(f"{path.name}-table")
    embeddings_BD = np.eye(rows, DIMENSION, dtype=np.float32)
    part = PartRows(
        keys=[f"gallery-{n}" for n in range(rows)],
        locations=[f"place{n}" for n in range(rows)],
        views=["satellite"] * rows,
        splits=["gallery"] * rows,
        lats=[47 + 0.009 * n for n in range(rows)],
        lons=[8.0] * rows,
        embeddings_BD=embeddings_BD,
    )
    write_part(
        str(table / "a.parquet"),
        part,
        PartFooter(fingerprint=fingerprint, shard_sha256="s", rows=rows),
    )
    build_index(IndexSettings(table=str(table), out=str(path)))
    return path


def replace(path: Path, new: Path) -> None:
    """Replace an index safely: the parts first, each by renaming, index.json last."""
    for name in sorted(
        (entry.name for entry in new.iterdir()), key=lambda name: name == "index.json"
    ):
        (new / name).replace(path / name)


class WidthEncoder:
    """Encodes a photo 16 + n pixels wide as location n."""

    perspective: Perspective = "as_taken"

    def __init__(self, metadata: IndexMetadata | None = None) -> None:
        self.batches: list[int] = []

    def to_input(self, image_HW3: Pixels) -> Pixels:
        return image_HW3

    def forward(self, images: Sequence[Pixels]) -> Floats:
        self.batches.append(len(images))
        numbers = [image_HW3.shape[1] - 16 for image_HW3 in images]
        return np.eye(DIMENSION, dtype=np.float32)[numbers].reshape(-1, DIMENSION)


def locate_request(number: int, **where: Any) -> LocateRequest:
    return LocateRequest(photo=photo(size=(16 + number, 16)), **where)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return make_index(tmp_path / "index", 3)


def test_live_index_switches_to_new_index(path: Path, tmp_path: Path) -> None:
    live = LiveIndex(str(path))
    before = live.current
    live.poll()
    assert live.current is before
    replace(path, make_index(tmp_path / "new", 5))
    live.poll()
    assert (len(live.current.index), live.refused) == (5, None)
    assert (
        before.index.search(np.eye(1, DIMENSION, 2, dtype=np.float32), 1)[0][0].key == "gallery-2"
    )


def broken_files(path: Path) -> None:
    (path / "index.faiss").write_bytes(b"no index")
    metadata = json_files.read_checksummed(str(path / "index.json"))
    json_files.write_checksummed(str(path / "index.json"), metadata | {"build_seconds": 9})


BROKEN = {
    "no index.json": lambda path: (path / "index.json").unlink(),
    "half of index.json": lambda path: (path / "index.json").write_text('{"rows": 5, '),
    "an index.json of something else": lambda path: (path / "index.json").write_text("[]"),
    "files that are no index": broken_files,
    "a calibration that is none": lambda path: (path / "calibration.json").write_text("{}"),
}


@pytest.mark.parametrize("harm", BROKEN.values(), ids=BROKEN)
def test_live_index_broken_one_is_refused(path: Path, harm: Any) -> None:
    copy = path.with_name("copy")
    shutil.copytree(path, copy)
    live = LiveIndex(str(path))
    before = live.current
    harm(path)
    live.poll()
    assert live.current is before
    assert live.refused is not None
    assert "\n" not in live.refused
    shutil.rmtree(path)
    shutil.copytree(copy, path)
    live.poll()
    assert live.refused is None


def test_live_index_of_another_encoder_is_refused(path: Path, tmp_path: Path) -> None:
    live = LiveIndex(str(path))
    replace(path, make_index(tmp_path / "new", 5, fingerprint="e" * 64))
    live.poll()
    assert len(live.current.index) == 3
    assert "made by encoder eeeeeeeeeeee" in str(live.refused)


def test_live_index_refused_one_is_retried_later(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A copy whose index.json came first is complete later, without another change of
    index.json."""
    live = LiveIndex(str(path))
    new = make_index(tmp_path / "new", 5)
    hidden = (path / "index.faiss").rename(tmp_path / "hidden")
    (new / "index.json").replace(path / "index.json")
    live.poll()
    assert live.refused
    hidden.rename(path / "index.faiss")
    replace(path, new)
    live.poll()
    assert len(live.current.index) == 3
    monkeypatch.setattr(live_index, "RETRY_S", 0.0)
    live.poll()
    assert len(live.current.index) == 5
    assert not live.refused


def test_live_index_changed_while_opened_waits_for_next_poll(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    live = LiveIndex(str(path))
    replace(path, make_index(tmp_path / "new", 4))
    newer = make_index(tmp_path / "newer", 5)
    opened = live_index.open_verified

    def slow(at: str, open_map: MapOpener = no_map) -> live_index.OpenedIndex:
        found = opened(at, open_map)
        if newer.joinpath("index.json").exists():
            replace(path, newer)
        return found

    monkeypatch.setattr(live_index, "open_verified", slow)
    live.poll()
    assert len(live.current.index) == 3
    live.poll()
    assert len(live.current.index) == 5


def test_live_index_missing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no index at"):
        LiveIndex(str(tmp_path / "none"))


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


@pytest.mark.slow
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


def test_service_answers_while_index_is_replaced(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two galleries in turn under a stream of requests; none fails, and the last index built is in
    use at the end."""
    predictor = Predictor(str(path), WidthEncoder)

    class InThisProcess:
        async def predict(self, requests: Sequence[LocateRequest]) -> list[Outcome]:
            return await asyncio.to_thread(predictor.predict, requests)

        async def picture(self, wanted: PictureRequest) -> bytes | None:
            return predictor.picture(wanted)

        async def status(self) -> ServiceStatus:
            return predictor.status()

    monkeypatch.setattr(live_index, "POLL_INTERVAL_S", 0.02)
    stop = threading.Event()

    async def main() -> list[int]:
        statuses = []
        service = Service(ServiceSettings(), InThisProcess())
        async with TestClient(TestServer(service.app)) as client:
            changing = asyncio.create_task(asyncio.to_thread(change))
            while not changing.done():
                kind = {"Content-Type": "image/jpeg"}
                posts = [
                    client.post("/locate", data=photo(size=(18, 16)), headers=kind)
                    for _ in range(4)
                ]
                for response in await asyncio.gather(*posts):
                    statuses.append(response.status)
                    assert (await response.json())["location"] == "place2"
            await changing
            health = await (await client.get("/health")).json()
            assert (health["rows"], health["refused"]) == (6, None)
        return statuses

    def change() -> None:
        for rows in (5, 4, 6):
            replace(path, make_index(tmp_path / f"new{rows}", rows))
            deadline = time.monotonic() + 5
            while predictor.status().rows != rows:
                assert time.monotonic() < deadline
                time.sleep(0.01)

    follower = threading.Thread(target=predictor.live.watch, args=(stop,))
    follower.start()
    try:
        statuses = asyncio.run(asyncio.wait_for(main(), 30))
    finally:
        stop.set()
        follower.join()
    assert len(statuses) > 10
    assert set(statuses) == {200}
