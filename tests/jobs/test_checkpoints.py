"""Checkpoints that outlive any kill: on after one within an epoch, after a damaged file, after a
worker's death.
"""

import json
import os
import signal
import threading
import time
from itertools import count
from pathlib import Path
from typing import Any

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from jobs.training.checkpoints import CheckpointWriter, list_archived
from jobs.training.driver import train
from jobs.training.settings import TrainSettings
from model.checkpoint import Checkpoint, loads
from model.training import Training
from pipeline.core import cluster
from pipeline.core.errors import Incomplete
from tests.jobs.tiny_runs import settings as tiny_settings
from tests.jobs.tiny_runs import tiny
from tests.processes import command_line, descendants, send_signal

pytestmark = pytest.mark.slow

TIMES = {"seconds", "images_per_second"}


def settings(shards: str, out: Path, **changes: Any) -> TrainSettings:
    """Three epochs, where nothing else is said."""
    return tiny_settings(shards, out, **({"recipe": tiny(3)} | changes))


def rows(out: Path) -> list[dict[str, Any]]:
    """metrics.jsonl without its times."""
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in line.items() if name not in TIMES} for line in lines]


def weights(out: Path) -> dict[str, torch.Tensor]:
    modules = loads((out / "last.pt").read_bytes()).state["modules"]
    return {
        f"{name}.{key}": tensor for name, state in modules.items() for key, tensor in state.items()
    }


def assert_same_run(one: Path, other: Path) -> None:
    first, second = weights(one), weights(other)
    assert first.keys() == second.keys()
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert rows(one) == rows(other)


@pytest.fixture(scope="module")
def undisturbed(tiny_shards: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("undisturbed")
    train(settings(tiny_shards, out))
    return out


class Killed(BaseException):
    pass


def kill_at(monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    """The process dies in its nth step."""
    real, taken = Training.step, iter(range(step))

    def mortal(self: Training, *arguments: Any) -> Any:
        if next(taken, None) is None:
            raise Killed
        return real(self, *arguments)

    monkeypatch.setattr(Training, "step", mortal)


@pytest.mark.parametrize(("minutes", "epochs", "step"), [(0.0, 1, 4), (60.0, 1, 5), (60.0, 2, 8)])
def test_train_killed_resumes_to_the_same_bits(
    tiny_shards: str, tmp_path: Path, undisturbed: Path, minutes: float, epochs: int, step: int
) -> None:
    changes: dict[str, Any] = {"checkpoint_minutes": minutes, "checkpoint_epochs": epochs}
    with pytest.MonkeyPatch.context() as patch:
        kill_at(patch, step)
        with pytest.raises(Killed):
            train(settings(tiny_shards, tmp_path, **changes))
    held = loads((tmp_path / "last.pt").read_bytes())
    assert (held.epoch, held.step) == {(0.0, 1): (1, 1), (60.0, 1): (1, 0), (60.0, 2): (2, 0)}[
        minutes, epochs
    ]
    train(settings(tiny_shards, tmp_path, **changes))
    assert_same_run(tmp_path, undisturbed)


@pytest.mark.parametrize("written", [False, True])
def test_train_killed_at_checkpoint_writes_one_row_per_epoch(
    tiny_shards: str, tmp_path: Path, undisturbed: Path, written: bool
) -> None:
    write = CheckpointWriter.write

    def killed(checkpoints: CheckpointWriter, checkpoint: Checkpoint) -> None:
        if checkpoint.epoch < 1 or written:
            write(checkpoints, checkpoint)
        if checkpoint.epoch == 1:
            raise Killed

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CheckpointWriter, "write", killed)
        with pytest.raises(Killed):
            train(settings(tiny_shards, tmp_path))
    time.sleep(1)  # TensorBoard orders a run's files by the second in which each was begun
    train(settings(tiny_shards, tmp_path))
    assert_same_run(tmp_path, undisturbed)
    assert on_board(tmp_path) == [1, 2, 3]


def on_board(out: Path) -> list[int]:
    """The epochs that TensorBoard shows."""
    board = EventAccumulator(str(out / "tensorboard"))
    board.Reload()
    return [event.step for event in board.Scalars("location_loss")]


def test_train_killed_ray_worker_is_replaced(
    tiny_shards: str, tmp_path: Path, ray_cluster: None, capfd: pytest.CaptureFixture[str]
) -> None:
    """The run ends with the bits of one in this process."""
    victims: list[int] = []
    out = tmp_path / "killed"

    def murder() -> None:
        while not (out / "last.pt").exists():
            time.sleep(0.01)
        ours = descendants(os.getpid())  # another session's Ray may run on this machine
        victims.extend(
            one
            for one in ours
            if "RayTrainWorker" in command_line(one) and send_signal(one, signal.SIGKILL)
        )

    killer = threading.Thread(target=murder, daemon=True)
    killer.start()
    train(settings(tiny_shards, out, recipe=tiny(8), workers=1))
    killer.join()
    assert len(victims) == 1
    assert "lost a worker" in capfd.readouterr().err
    assert [row["epoch"] for row in rows(out)] == list(range(1, 9))
    threads = torch.get_num_threads()
    torch.set_num_threads(cluster.cpus())  # as many as the worker has
    train(settings(tiny_shards, tmp_path / "whole", recipe=tiny(8)))
    torch.set_num_threads(threads)
    assert_same_run(out, tmp_path / "whole")


def test_find_checkpoint_falls_back_from_damaged_one(
    tiny_shards: str, tmp_path: Path, undisturbed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        kill_at(patch, 5)
        with pytest.raises(Killed):
            train(settings(tiny_shards, tmp_path, keep=3))
    assert list_archived(str(tmp_path)) == ["checkpoint-0001-00001.pt", "checkpoint-0001-00000.pt"]
    last = tmp_path / "last.pt"
    last.write_bytes(last.read_bytes()[:-1000])
    train(settings(tiny_shards, tmp_path))
    said = capsys.readouterr().err
    assert "last.pt is damaged" in said
    assert "taking checkpoint-0001-00001.pt, the one before it" in said
    assert "resuming after epoch 1 of 3 and 1 of 3 steps" in said
    assert_same_run(tmp_path, undisturbed)
    assert list_archived(str(tmp_path)) == ["checkpoint-0002-00002.pt"]


def test_train_diverging_keeps_the_last_good_checkpoint(
    tiny_shards: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = Training.step

    def poisoned(self: Training, *arguments: Any) -> Any:
        if next(steps) == 6:  # the first of the third epoch
            with torch.no_grad():
                next(self.model.classifier.parameters()).fill_(float("inf"))
        return real(self, *arguments)

    steps = count()
    monkeypatch.setattr(Training, "step", poisoned)
    with pytest.raises(
        Incomplete,
        match=r"diverged in epoch 3, by step 1 of 3: location_loss\S* is nan, expected a finite",
    ):
        train(settings(tiny_shards, tmp_path))
    held = loads((tmp_path / "last.pt").read_bytes())
    assert [row["epoch"] for row in rows(tmp_path)] == [1, 2]
    assert (held.epoch, held.step) == (2, 0)
