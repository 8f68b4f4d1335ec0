"""`ray job submit --working-dir . -- python jobs/X.py …` against the session's Ray."""

import os
import subprocess
import sys
import time
import urllib.request
from functools import partial
from pathlib import Path

import pytest

from tests.processes import Cluster

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent


@pytest.fixture
def submit_environment(ray_session: Cluster) -> dict[str, str]:
    """The environment of `ray job submit`, once the session's Ray takes jobs."""
    environment = os.environ | {
        "PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}",
        "RAY_API_SERVER_ADDRESS": ray_session.dashboard,
    }
    environment.pop("RAY_ADDRESS", None)
    deadline = time.monotonic() + 120
    while not takes_jobs(ray_session.dashboard):
        assert time.monotonic() < deadline
        time.sleep(0.2)
    return environment


def takes_jobs(address: str) -> bool:
    try:
        with urllib.request.urlopen(f"{address}/api/jobs/", timeout=20) as answered:
            return bool(answered.status == 200)
    except OSError:  # it does not listen yet, or cannot tell yet
        return False


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
    """Tasks (they verify the shards) and Ray Train, beside a pool of actors: all of them import the
    project."""
    run, table = tmp_path / "run", tmp_path / "table"
    small = (
        "--workers 1 --epochs 1 --batch-size 2 --part-dim 16 --discriminator-channels 16 --verify"
    )
    begin = partial(submit, submit_environment)
    training = begin("train", "smoke", "--shards", tiny_shards, "--out", run, *small.split())
    images = ("--split", "query", "--view", "drone")
    embedding = begin("embed_gallery", "--shards", tiny_shards, "--out", table, *images)
    answer(training)
    answer(embedding)
    assert (run / "last.pt").exists()
    assert list(table.glob("*.parquet"))
