"""Joining Ray, and calls with a bounded number in flight."""

from typing import Any

import pytest
import ray

from pipeline import cluster


@pytest.mark.parametrize(("named", "joined"), [(None, "local"), ("10.0.0.1:6379", "10.0.0.1:6379")])
def test_a_job_joins_the_named_cluster_or_starts_its_own_and_never_a_strangers(
    monkeypatch: pytest.MonkeyPatch, named: str | None, joined: str
) -> None:
    asked: dict[str, Any] = {}
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", lambda **settings: asked.update(settings))
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    if named is not None:
        monkeypatch.setenv("RAY_ADDRESS", named)
    cluster.connect()
    assert asked["address"] == joined


def test_calls_come_back_with_their_items_and_never_more_than_the_window_is_in_flight(ray_cluster: None) -> None:
    flying, most = 0, 0
    double: Any = ray.remote(lambda number: 2 * number)

    def submit(number: int) -> Any:
        nonlocal flying, most
        flying += 1
        most = max(most, flying)
        return double.remote(number)

    results = {}
    for item, result in cluster.bounded(submit, range(9), window=3):
        results[item] = result
        flying -= 1
    assert results == {number: 2 * number for number in range(9)}
    assert most <= 4  # the following call is submitted just before a result is handed on


def test_a_call_that_fails_is_raised_here(ray_cluster: None) -> None:
    fail: Any = ray.remote(lambda number: 1 // number)
    with pytest.raises(ZeroDivisionError):
        list(cluster.bounded(fail.remote, [0], window=1))
