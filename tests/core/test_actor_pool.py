"""A crew of actors: every item once, whoever dies, and nobody waits for those who have not come."""

import os
import time
from typing import Any

import pytest
import ray

from pipeline.core import cluster
from pipeline.core.actor_pool import ActorPool, NoWorkerStarted, PoolConfig, PoolFailed, Skipped


def terms(
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


def test_every_item_is_done_once(ray_cluster: None) -> None:
    crew = ActorPool(terms())
    assert sorted(crew.work(range(20))) == [(item, 2 * item) for item in range(20)]
    assert crew.seconds > 0
    assert crew.working == 0


def test_nothing_to_do_hires_nobody() -> None:
    assert list(ActorPool(PoolConfig(create_actor=list, size=2, resources="")).work([])) == []


def test_an_item_that_kills_is_set_aside_and_its_neighbours_are_not_blamed(
    ray_cluster: None,
) -> None:
    found = dict(
        ActorPool(terms(do=lambda item: os._exit(1) if item == 1 else None, size=1)).work(range(4))
    )
    assert isinstance(found.pop(1), Skipped)
    assert found == {0: 0, 2: 4, 3: 6}


def test_an_item_that_is_refused_costs_no_actor_and_a_fatal_error_ends_the_work(
    ray_cluster: None,
) -> None:
    crew = ActorPool(terms(do=lambda item: {}[item], size=1, refusals=(KeyError,)))
    assert dict(crew.work([5])) == {5: Skipped(reason="unusable", found="5")}
    with pytest.raises(KeyError):
        list(ActorPool(terms(do=lambda item: {}[item], size=1, fatal=(KeyError,))).work([5]))


def test_actors_that_cannot_start_are_told(ray_cluster: None) -> None:
    with pytest.raises(
        PoolFailed,
        match="a worker cannot start: ZeroDivisionError: integer division or modulo by zero",
    ):
        list(ActorPool(terms(start=lambda: 1 // 0, size=1)).work(range(9)))
    with pytest.raises(PoolFailed, match="a worker cannot start: ActorDiedError"):
        list(ActorPool(terms(start=lambda: os._exit(1), size=1)).work(range(9)))


def test_those_that_have_not_come_keep_nobody_from_working(ray_cluster: None) -> None:
    hired = iter([terms(), terms(cpus=1000), terms(cpus=1000)])
    crew = ActorPool(
        PoolConfig(create_actor=lambda: next(hired).create_actor(), size=3, resources="")
    )
    assert len(list(crew.work(range(10)))) == 10
    with pytest.raises(
        NoWorkerStarted, match="no worker has started for 1 s; each asks for a little"
    ):
        list(ActorPool(terms(cpus=1000, patience=1.0)).work(range(3)))


def test_actors_that_are_still_starting_at_the_end_give_their_places_back(
    ray_cluster: None,
) -> None:
    for patience in (0.2, 1.0):
        slow = terms(start=lambda: time.sleep(10), cpus=1, patience=patience)
        with pytest.raises(NoWorkerStarted):
            list(ActorPool(slow).work([1, 2]))
    until = time.monotonic() + 60
    while free_cpus() < cluster.cpus() and time.monotonic() < until:
        time.sleep(0.1)
    assert free_cpus() == cluster.cpus()


def free_cpus() -> float:
    free: dict[str, float] = ray.available_resources()  # type: ignore[no-untyped-call]
    return free.get("CPU", 0.0)
