"""An actor pool: every item once, whichever actor dies, without waiting for actors that have not
started."""

import os
import time
from typing import Any

import pytest
import ray

from pipeline.core import cluster
from pipeline.core.actor_pool import (
    ActorPool,
    NoWorkerStarted,
    PoolConfig,
    PoolFailed,
    Skipped,
)


def pool_config(
    start: Any = None, do: Any = None, size: int = 2, cpus: float = 0.01, **more: Any
) -> PoolConfig:
    class Doubler:
        def start(self) -> None:
            if start:
                start()

        def work(self, item: int) -> int:
            if do:
                do(item)
            return 2 * item

    actor: Any = ray.remote(num_cpus=cpus)(Doubler).options(max_concurrency=2)
    return PoolConfig(create_actor=actor.remote, size=size, resources="a little", **more)


def test_pool_does_every_item_once(ray_cluster: None) -> None:
    pool = ActorPool(pool_config())
    assert sorted(pool.work(range(20))) == [(item, 2 * item) for item in range(20)]
    assert pool.seconds > 0
    assert pool.ready_workers == 0


def test_pool_without_items_creates_no_actor() -> None:
    assert list(ActorPool(PoolConfig(create_actor=list, size=2, resources="")).work([])) == []


def test_pool_skips_the_item_that_kills_and_no_neighbour(ray_cluster: None) -> None:
    config = pool_config(do=lambda item: os._exit(1) if item == 1 else None, size=1)
    results = dict(ActorPool(config).work(range(4)))
    assert isinstance(results.pop(1), Skipped)
    assert results == {0: 0, 2: 4, 3: 6}


def test_pool_skips_on_named_errors_and_raises_fatal_ones(ray_cluster: None) -> None:
    pool = ActorPool(pool_config(do=lambda item: {}[item], size=1, skip_on=(KeyError,)))
    assert dict(pool.work([5])) == {5: Skipped(reason="unusable", found="5")}
    with pytest.raises(KeyError):
        list(ActorPool(pool_config(do=lambda item: {}[item], size=1, fatal=(KeyError,))).work([5]))


def test_pool_fails_if_actors_cannot_start(ray_cluster: None) -> None:
    with pytest.raises(
        PoolFailed,
        match="a worker cannot start: ZeroDivisionError: integer division or modulo by zero",
    ):
        list(ActorPool(pool_config(start=lambda: 1 // 0, size=1)).work(range(9)))
    with pytest.raises(PoolFailed, match="a worker cannot start: ActorDiedError"):
        list(ActorPool(pool_config(start=lambda: os._exit(1), size=1)).work(range(9)))


def test_pool_works_while_other_actors_wait_to_start(ray_cluster: None) -> None:
    configs = iter([pool_config(), pool_config(cpus=1000), pool_config(cpus=1000)])
    pool = ActorPool(
        PoolConfig(create_actor=lambda: next(configs).create_actor(), size=3, resources="")
    )
    assert len(list(pool.work(range(10)))) == 10
    with pytest.raises(
        NoWorkerStarted, match="no worker has started for 1 s; each asks for a little"
    ):
        list(ActorPool(pool_config(cpus=1000, patience=1.0)).work(range(3)))


def test_pool_frees_the_cpus_of_actors_still_starting(ray_cluster: None) -> None:
    for patience in (0.2, 1.0):
        slow = pool_config(start=lambda: time.sleep(10), cpus=1, patience=patience)
        with pytest.raises(NoWorkerStarted):
            list(ActorPool(slow).work([1, 2]))
    until = time.monotonic() + 60
    while free_cpus() < cluster.cpus() and time.monotonic() < until:
        time.sleep(0.1)
    assert free_cpus() == cluster.cpus()


def free_cpus() -> float:
    free: dict[str, float] = ray.available_resources()  # type: ignore[no-untyped-call]
    return free.get("CPU", 0.0)
