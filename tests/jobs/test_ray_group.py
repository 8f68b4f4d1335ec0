"""Training by a group of Ray Train workers.

That it takes the steps of a training in this process is in test_checkpoints.py, with a worker that
dies meanwhile.
"""

import os
import queue
import shutil
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import ray
import torch
from ray.exceptions import RayActorError
from ray.util.queue import Queue

from jobs.training import ray_group
from jobs.training.driver import train
from jobs.training.ray_group import listen
from model.checkpoint import loads
from model.errors import CheckpointError
from pipeline.core.errors import Incomplete, InputError
from pipeline.core.progress import progress
from tests.jobs.tiny_runs import settings, tiny


def test_train_sync_bn_without_gpus_is_rejected(
    tiny_shards: str, tmp_path: Path, ray_cluster: None
) -> None:
    recipe = replace(tiny(1), sync_bn=True)
    with pytest.raises(InputError, match="2 workers have no GPUs, expected GPUs"):
        train(settings(tiny_shards, tmp_path, recipe, workers=2))


def test_train_two_ray_workers_end_at_damaged_input(
    tiny_shards: str, tmp_path: Path, ray_cluster: None, capfd: pytest.CaptureFixture[str]
) -> None:
    """They share one network, with one step an epoch in place of two, until their input is damaged,
    which is not tried again."""
    shards, run = shutil.copytree(tiny_shards, tmp_path / "shards"), tmp_path / "run"

    def damage() -> None:
        while not (run / "last.pt").exists():
            time.sleep(0.01)
        for tar in Path(shards).glob("train-*.tar"):
            tar.write_bytes(tar.read_bytes()[:1000])

    threading.Thread(target=damage, daemon=True).start()
    recipe = replace(tiny(1000), batch_size=3)
    with pytest.raises(InputError, match=r"train-\S+\.tar"):
        train(settings(str(shards), run, recipe, workers=2, checkpoint_minutes=60.0))
    assert "lost a worker" not in capfd.readouterr().err
    named = [one["name"] for one in ray.util.list_named_actors(all_namespaces=True)]
    assert not [name for name in named if "Autoscaling" in name], "a process that takes seconds"
    assert loads((run / "last.pt").read_bytes()).history[0]["step"] == 1


@pytest.mark.parametrize("kind", [Incomplete, InputError, CheckpointError])
def test_ray_worker_hands_over_errors_of_the_run(
    kind: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as that a training has diverged: every other group would meet it too."""
    error, told = kind("training diverged in epoch 1"), queue.Queue[dict[str, Any]]()

    def fail(*_: object) -> None:
        raise error

    alone = SimpleNamespace(get_world_rank=lambda: 0, get_world_size=lambda: 1)
    monkeypatch.setattr(ray_group, "get_context", lambda: alone)
    monkeypatch.setattr(ray_group, "get_device", lambda: torch.device("cpu"))
    monkeypatch.setattr(ray_group, "train_worker", fail)
    with pytest.raises(kind, match="diverged"):
        ray_group.ray_worker({"run": None, "messages": told, "cpus": torch.get_num_threads()})
    assert told.get_nowait() == {"refused": error}


def test_queue_put_after_shutdown_raises(ray_cluster: None) -> None:
    """SIGTERM lets an actor finish what it was asked; asked without an end, it neither went nor
    answered (seed 22).
    """
    told = Queue(actor_options={"num_cpus": 0})
    actor: Any = told.actor
    pid: int = ray.get(actor.__ray_call__.remote(lambda queue: os.getpid()))
    with progress(None, "training", "steps") as meter:
        listener = threading.Thread(target=listen, args=(told, meter, []), daemon=True)
        listener.start()
        time.sleep(0.5)  # it asks
        os.kill(pid, signal.SIGTERM)
        time.sleep(0.5)  # the actor has heard
        with pytest.raises(RayActorError):
            ray.get(actor.put.remote({"steps": 1}), timeout=20)
        listener.join(20)
    assert not listener.is_alive()
