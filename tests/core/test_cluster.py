"""Calls with a bounded number in flight; which cluster is joined; how workers are placed on it."""

import socket
from pathlib import Path
from typing import Any

import pytest
import ray
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core import cluster
from pipeline.core.cluster import Node, Placement, plan_placement

NODES = st.lists(
    st.builds(Node, cpus=st.integers(1, 64), gpus=st.integers(0, 8)), min_size=1, max_size=5
)


def test_tasks_pay_where_a_cluster_is_or_work_outweighs_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path))  # where `ray start` notes its address
    monkeypatch.setenv("RAY_ADDRESS", "local")
    assert not cluster.tasks_pay(cluster.START_S)
    assert cluster.tasks_pay(10 * cluster.START_S)
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:6379")
    assert cluster.tasks_pay(0.0)
    monkeypatch.delenv("RAY_ADDRESS")
    assert not cluster.tasks_pay(0.0)
    (tmp_path / "ray").mkdir()
    (tmp_path / "ray" / "ray_current_cluster").write_text("127.0.0.1:6379")
    assert cluster.tasks_pay(0.0)


def test_workers_draw_other_random_ids(ray_cluster: None) -> None:
    """Those of the tests are forked from one process; with the same ids they would take each
    other's objects.
    """

    class Worker:
        def first_ids(self) -> tuple[str, ...]:
            return tuple(ray.ObjectRef.from_random().hex() for _ in range(20))

    workers: list[Any] = [ray.remote(num_cpus=0)(Worker).remote() for _ in range(2)]
    some, others = ray.get([worker.first_ids.remote() for worker in workers])
    for worker in workers:
        ray.kill(worker)
    assert set(some).isdisjoint(others)


def test_bounded_map_pairs_results_within_its_window(ray_cluster: None) -> None:
    in_flight, most = 0, 0
    double: Any = ray.remote(lambda number: 2 * number)

    def submit(number: int) -> Any:
        nonlocal in_flight, most
        in_flight += 1
        most = max(most, in_flight)
        return double.remote(number)

    results = {}
    for item, result in cluster.bounded_map(submit, range(9), window=3):
        results[item] = result
        in_flight -= 1
    assert results == {number: 2 * number for number in range(9)}
    assert most <= 4  # the following call is submitted just before a result is yielded


def test_bounded_map_raises_a_calls_own_error(ray_cluster: None) -> None:
    fail: Any = ray.remote(lambda number: 1 // number)
    with pytest.raises(ZeroDivisionError):
        list(cluster.bounded_map(fail.remote, [0], window=1))


def test_connect_does_not_wait_for_a_dead_cluster(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """`ray start` leaves its address in a file that outlives a killed cluster; Ray would wait for
    that cluster for ever."""
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path))
    assert cluster._address() is None  # no `ray start` on this machine
    (tmp_path / "ray").mkdir()
    with socket.create_server(("127.0.0.1", 0)) as alive:
        noted = f"127.0.0.1:{alive.getsockname()[1]}"
        (tmp_path / "ray" / "ray_current_cluster").write_text(noted)
        assert cluster._address() is None  # Ray finds it by itself
    assert cluster._address() == "local"
    assert f"the Ray cluster at {noted} that `ray start` began is gone" in capsys.readouterr().err
    monkeypatch.setenv("RAY_ADDRESS", noted)
    assert cluster._address() is None  # an address that the user names is used


def test_noted_address_is_read_where_ray_keeps_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Ray has no public name for that file: a version that moves it shows here first."""
    utils = pytest.importorskip("ray._common.utils")
    for variable in ("RAY_TMPDIR", "TMPDIR"):
        monkeypatch.delenv("RAY_TMPDIR", raising=False)
        monkeypatch.setenv(variable, str(tmp_path / variable))
        file = Path(utils.get_ray_address_file(None))
        file.parent.mkdir(parents=True)
        file.write_text("127.0.0.1:6379\n")
        assert cluster._noted_address() == "127.0.0.1:6379"


def test_placement_is_per_gpu_else_per_eight_cores() -> None:
    for nodes, asked, expected in (
        ([Node(cpus=2)], {}, (1, 2, 0)),
        ([Node(cpus=2)], {"workers": 2}, (2, 1, 0)),
        ([Node(cpus=2)], {"workers": 3}, (3, 1, 0)),
        ([Node(cpus=16), Node(cpus=16)], {}, (4, 8, 0)),
        ([Node(cpus=6)] * 3, {"workers": 2}, (2, 6, 0)),
        ([Node(cpus=32, gpus=4)], {}, (4, 8, 1)),
        ([Node(cpus=32, gpus=4)], {"gpus": 0.5}, (8, 4, 0.5)),
        ([Node(cpus=32, gpus=4)], {"items": 2, "gpus": 0}, (2, 16, 0)),
        ([Node(cpus=0), Node(cpus=4)], {"cpus": 2}, (2, 2, 0)),
    ):
        workers, cpus, gpus = expected
        settings: Any = {"items": 9} | asked
        found = plan_placement(nodes, **settings)
        assert found == Placement(workers=workers, cpus=cpus, gpus=gpus)


@given(NODES, st.integers(1, 100))
def test_placement_fits_the_nodes(nodes: list[Node], items: int) -> None:
    chosen = plan_placement(nodes, items)
    assert 1 <= chosen.workers <= items
    room = sum(
        min(node.cpus // chosen.cpus, node.gpus // chosen.gpus)
        if chosen.gpus
        else node.cpus // chosen.cpus
        for node in nodes
    )
    assert room >= chosen.workers


@given(NODES, st.integers(1, 100), st.integers(1, 64), st.integers(1, 64))
def test_placement_keeps_what_the_user_asks_for(
    nodes: list[Node], items: int, workers: int, cpus: int
) -> None:
    chosen = plan_placement(nodes, items, workers, cpus, 0)
    assert (chosen.workers, chosen.cpus, chosen.gpus) == (min(workers, items), cpus, 0)
