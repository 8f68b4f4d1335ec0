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

from pipeline.core import json_files
from pipeline.core.errors import InputError
from pipeline.service import live_index
from pipeline.service.app import Service
from pipeline.service.live_index import LiveIndex
from pipeline.service.photo_map import MapOpener, PictureRequest, no_map
from pipeline.service.predictor import Outcome, Predictor, ServiceStatus
from pipeline.service.request import LocateRequest
from pipeline.service.settings import ServiceSettings
from tests.service.made_index import DIMENSION, WidthEncoder, make_index
from tests.service.photos import photo

pytestmark = pytest.mark.slow


def replace(path: Path, new: Path) -> None:
    """Replace an index safely: the parts first, each by renaming, index.json last."""
    for name in sorted(
        (entry.name for entry in new.iterdir()), key=lambda name: name == "index.json"
    ):
        (new / name).replace(path / name)


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


@pytest.mark.slow
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
