"""Calls with a bounded number in flight; which cluster is joined."""

import socket
from typing import Any

import pytest
import ray

from pipeline.core import cluster


def test_calls_come_back_with_their_items_and_never_more_than_the_window_is_in_flight(
    ray_cluster: None,
) -> None:
    flying, most = 0, 0
    double: Any = ray.remote(lambda number: 2 * number)

    def submit(number: int) -> Any:
        nonlocal flying, most
        flying += 1
        most = max(most, flying)
        return double.remote(number)

    results = {}
    for item, result in cluster.bounded_map(submit, range(9), window=3):
        results[item] = result
        flying -= 1
    assert results == {number: 2 * number for number in range(9)}
    assert most <= 4  # the following call is submitted just before a result is handed on


def test_a_call_that_fails_is_raised_here(ray_cluster: None) -> None:
    fail: Any = ray.remote(lambda number: 1 // number)
    with pytest.raises(ZeroDivisionError):
        list(cluster.bounded_map(fail.remote, [0], window=1))


def test_a_cluster_that_is_no_more_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`ray start` leaves its address in a file that outlives a killed cluster; Ray would wait for
    that one for ever.
    """
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    with socket.create_server(("127.0.0.1", 0)) as alive:
        noted = f"127.0.0.1:{alive.getsockname()[1]}"
        monkeypatch.setattr(cluster, "read_ray_address", lambda: noted)
        assert cluster._address() is None  # Ray finds it by itself
    assert cluster._address() == "local"
    assert f"the Ray cluster at {noted} that `ray start` began is gone" in capsys.readouterr().err
    monkeypatch.setenv("RAY_ADDRESS", noted)
    assert cluster._address() is None  # whoever names one means it
    monkeypatch.delenv("RAY_ADDRESS")
    monkeypatch.setattr(cluster, "read_ray_address", lambda: "")
    assert cluster._address() is None
