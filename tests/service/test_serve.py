"""The serve job end to end: an encoder and an index behind Ray Serve, called over HTTP, killed,
stopped."""

import asyncio
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from jobs.encoding.photo_encoder import PhotoEncoder
from jobs.stages.serve import load_predictor
from jobs.stages.serve import serve as main
from jobs.stages.settings import ServeSettings
from model.checkpoint import Checkpoint, dumps
from model.config import PVDAConfig
from pipeline.core import json_files
from pipeline.core.errors import InputError
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.index.build import build_index
from pipeline.index.settings import IndexSettings
from pipeline.service import replicas
from pipeline.service.engine import NotReady
from pipeline.service.replicas import Replica
from tests.conftest import make_lively_encoder
from tests.jobs.test_photo_encoder import identity_of, photo
from tests.processes import command_line, descendants

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint, and an index of three photos that it embedded."""
    folder = tmp_path_factory.mktemp("made")
    encoder = make_lively_encoder()
    state = {"modules": {"encoder": encoder.state_dict()}}
    config = PVDAConfig(backbone="resnet18", width=0.25, image_size=64, parts=2, part_dim=16)
    data = dumps(
        Checkpoint(network=config, recipe={}, locations=[], epoch=0, history=[], state=state)
    )
    (folder / "last.pt").write_bytes(data)
    embeddings_BD, _ = PhotoEncoder(data, "last.pt", *identity_of(data)).encode(
        [photo(seed) for seed in range(3)]
    )
    part = PartRows(
        keys=[f"gallery-{n}" for n in range(3)],
        locations=[f"place{n}" for n in range(3)],
        views=["satellite"] * 3,
        splits=["gallery"] * 3,
        lats=[47.0, 47.01, 47.02],
        lons=[8.0] * 3,
        embeddings_BD=embeddings_BD,
    )
    footer = PartFooter(
        fingerprint=identity_of(data)[0], shard_sha256="s", rows=3, encoding=identity_of(data)[1]
    )
    write_part(str(folder / "table" / "a.parquet"), part, footer)
    build_index(IndexSettings(table=str(folder / "table"), out=str(folder / "index")))
    return folder


@pytest.fixture
def checkpoint_and_index(tmp_path: Path, made: Path) -> tuple[Path, Path]:
    """A copy of them."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    return tmp_path / "last.pt", tmp_path / "index"


def command(*arguments: object) -> list[str]:
    return [sys.executable, str(ROOT / "jobs" / "serve.py"), *map(str, arguments)]


@contextmanager
def started(*arguments: object) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The job in a process of its own, and its address once it listens."""
    with subprocess.Popen(
        command(*arguments), stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            assert process.stderr is not None
            line = process.stderr.readline()
            address = re.match(r"(http://\S+) listens", line)
            assert address, line + process.stderr.read()
            yield process, address[1]
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)


def get(url: str, data: bytes | None = None) -> tuple[int, Any]:
    """Status and JSON body."""
    request = urllib.request.Request(
        url, data, {"Content-Type": "image/jpeg"} if data is not None else {}
    )
    try:
        with urllib.request.urlopen(request, timeout=40) as response:
            return response.status, json.load(response)
    except urllib.error.HTTPError as error:
        with error:
            return error.code, json.load(error)


def wait_ready(address: str) -> dict[str, Any]:
    for _ in range(300):
        status, health = get(f"{address}/health")
        if status == 200:
            return dict(health)
        assert status == 503
        assert health["why"]
        time.sleep(0.2)
    raise AssertionError("not ready after a minute")


def replica_of(process: subprocess.Popen[str]) -> int:
    """The process id of the service's replica, by the name that Ray gives it."""
    name = f"ray::ServeReplica:pvda-{process.pid}:Replica"
    return next(one for one in descendants(os.getpid()) if command_line(one).startswith(name))


def serve_actors() -> list[str]:
    """The actors of Ray Serve on the session's cluster."""
    import ray

    named = [str(actor["name"]) for actor in ray.util.list_named_actors(all_namespaces=True)]
    return [name for name in named if name.startswith("SERVE")]


def test_serve_answers_replaces_replica_and_ends_cleanly(
    checkpoint_and_index: tuple[Path, Path], ray_address: str
) -> None:
    checkpoint, index = checkpoint_and_index
    with started("--checkpoint", checkpoint, "--index", index, "--port", 0, "--threads", 1) as (
        process,
        address,
    ):
        health = wait_ready(address)
        assert (health["rows"], health["refused"]) == (3, None)
        for seed in range(3):
            status, answer = get(f"{address}/locate", photo(seed))
            assert (status, answer["location"]) == (200, f"place{seed}")
            assert answer["candidates"][0]["score"] == pytest.approx(1, abs=1e-4)
        assert get(f"{address}/locate", photo(1)[:-40])[0] == 422
        os.kill(replica_of(process), signal.SIGKILL)
        status, answer = get(f"{address}/locate", photo(2))
        assert (status, answer["location"]) == (200, "place2")
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=20) == 0
    assert not serve_actors()


def test_serve_other_encoder_is_refused(
    checkpoint_and_index: tuple[Path, Path], ray_cluster: None
) -> None:
    checkpoint, index = checkpoint_and_index
    metadata = json_files.read_checksummed(str(index / "index.json"))
    json_files.write_checksummed(str(index / "index.json"), metadata | {"fingerprint": "e" * 64})
    with pytest.raises(InputError, match="did not make this index") as refused:
        main(ServeSettings(checkpoint=str(checkpoint), index=str(index), port=0, threads=1))
    assert "\n" not in str(refused.value)
    assert "Replica" not in str(refused.value)
    assert not serve_actors()


def test_serve_missing_input_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no checkpoint at"):
        main(ServeSettings(checkpoint=str(tmp_path / "none.pt"), index=str(tmp_path)))
    with pytest.raises(InputError, match="no index at"):
        main(ServeSettings(checkpoint=__file__, index=str(tmp_path)))
    with pytest.raises(InputError, match="--replicas is 0"):
        ServeSettings(checkpoint="last.pt", index="index", replicas=0)


def test_serve_port_in_use_is_refused(
    checkpoint_and_index: tuple[Path, Path], ray_cluster: None
) -> None:
    checkpoint, index = checkpoint_and_index
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"cannot listen on 127.0.0.1 port {port}"):
            main(ServeSettings(checkpoint=str(checkpoint), index=str(index), port=port))


def test_replica_retries_loading(
    checkpoint_and_index: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint, index = checkpoint_and_index
    monkeypatch.setattr(replicas, "RETRY_S", 0.02)
    hidden = index.rename(index.with_name("hidden"))
    replica = Replica(partial(load_predictor, str(checkpoint), str(index), None, 1))
    with pytest.raises(NotReady, match="no index at"):
        asyncio.run(replica.status())
    replica.check_health()  # another process would not find an index either
    hidden.rename(index)
    deadline = time.monotonic() + 10
    while replica._predictor is None and time.monotonic() < deadline:
        time.sleep(0.01)
    assert asyncio.run(replica.status()).rows == 3


def test_replica_stuck_batch_fails_health_check(
    checkpoint_and_index: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    replica = Replica(
        partial(load_predictor, str(checkpoint_and_index[0]), str(checkpoint_and_index[1]), None, 1)
    )
    replica._batch_began = time.monotonic() - replicas.BATCH_TIMEOUT_S - 1
    with pytest.raises(TimeoutError, match="120 s"):
        replica.check_health()
