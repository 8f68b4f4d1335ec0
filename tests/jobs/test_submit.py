"""`ray job submit --working-dir . -- python jobs/X.py …` against a cluster that this test starts
and ends itself.
"""

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent


def free_ports(count: int) -> list[int]:
    sockets = [socket.socket() for _ in range(count)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    ports = [int(one.getsockname()[1]) for one in sockets]
    for one in sockets:
        one.close()
    return ports


def takes_jobs(address: str) -> bool:
    try:
        with urllib.request.urlopen(f"{address}/api/jobs/", timeout=20) as answered:
            return bool(answered.status == 200)
    except OSError:  # it does not listen yet, or cannot tell yet
        return False


@pytest.fixture(scope="module")
def submit_environment() -> Iterator[dict[str, str]]:
    """A head node of its own ports and session folder; ended by its process group, never by `ray
    stop`.
    """
    port, dashboard, client = free_ports(3)
    # Not in pytest's folder: the paths of Ray's sockets may have 107 characters.
    scratch = Path(tempfile.mkdtemp(prefix="ray-"))
    environment = os.environ | {
        "RAY_AUTH_MODE": "disabled",
        "PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}",
    }
    environment.pop("RAY_ADDRESS", None)
    command = [
        str(BIN / "ray"),
        "start",
        "--head",
        "--block",
        "--node-ip-address=127.0.0.1",
        f"--port={port}",
        f"--dashboard-port={dashboard}",
        f"--ray-client-server-port={client}",
        "--num-cpus=2",
        f"--temp-dir={scratch}",
        "--disable-usage-stats",
        f"--dashboard-agent-listen-port={free_ports(1)[0]}",
    ]
    with (scratch / "head.log").open("wb") as log:
        head = subprocess.Popen(
            command, env=environment, stdout=log, stderr=log, start_new_session=True
        )
    address = f"http://127.0.0.1:{dashboard}"
    try:
        deadline = time.monotonic() + 120
        while not takes_jobs(address):
            over = head.poll() is not None or time.monotonic() > deadline
            assert not over, (scratch / "head.log").read_text()
            time.sleep(0.2)
        yield environment | {"RAY_API_SERVER_ADDRESS": address}
    finally:
        head.terminate()  # `--block` ends the processes that it started, and then itself
        try:
            head.wait(timeout=1)
        except subprocess.TimeoutExpired:
            os.killpg(head.pid, signal.SIGKILL)
            head.wait()
        shutil.rmtree(scratch, ignore_errors=True)


def submit(environment: dict[str, str], job: str, *arguments: object) -> "subprocess.Popen[str]":
    """A job on its way to the cluster."""
    command = [
        "ray",
        "job",
        "submit",
        "--working-dir",
        ".",
        "--",
        "python",
        f"jobs/{job}.py",
        *map(str, arguments),
    ]
    return subprocess.Popen(
        [str(BIN / command[0]), *command[1:]], env=environment, cwd=ROOT, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip


def answer(submitted: "subprocess.Popen[str]") -> str:
    """What a job said, which must have succeeded."""
    said, _ = submitted.communicate(timeout=300)
    assert submitted.returncode == 0, said[-5000:]
    assert "succeeded" in said
    return said


def test_submit_runs_tasks_training_and_actors(
    submit_environment: dict[str, str], tiny_shards: str, tmp_path: Path
) -> None:
    """A job of each kind: Ray's tasks, Ray Train, and a pool of actors that import the project."""
    flights, run, table = (tmp_path / name for name in ("flights", "run", "table"))
    counts = "--train-locations 4 --test-locations 2 --distractors 1 --views 2 --size 64"
    small = "--workers 1 --epochs 1 --batch-size 2 --part-dim 16 --discriminator-channels 16"
    begin = partial(submit, submit_environment)
    training = begin("train", "smoke", "--shards", tiny_shards, "--out", run, *small.split())
    simulating = begin("simulate", "--out", flights, *counts.split())
    answer(training)
    network = ("--checkpoint", run / "last.pt", "--split", "query", "--view", "drone")
    embedding = begin("embed_gallery", "--shards", tiny_shards, "--out", table, *network)
    answer(simulating)
    answer(embedding)
    assert len(list((flights / "train" / "satellite").rglob("*.jpg"))) == 4
    assert list(table.glob("*.parquet"))
