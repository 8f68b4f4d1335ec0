"""Prefetching keeps the order, stays within its depth, and raises errors in their place."""

from collections.abc import Iterator
from itertools import count
from threading import Event

import pytest

from pipeline.core.prefetch import prefetch, prefetch_map
from pipeline.images.decode import DecodeError


def test_prefetch_map_keeps_order_within_its_depth() -> None:
    drawn = count()
    numbers: Iterator[int] = (next(drawn) for _ in range(100))
    results = prefetch_map(lambda number: number * number, numbers, threads=3, depth=5)
    assert [next(results) for _ in range(4)] == [0, 1, 4, 9]
    assert next(drawn) <= 4 + 5
    results.close()  # type: ignore[attr-defined]


def test_prefetch_map_raises_an_error_in_order() -> None:
    started = Event()

    def work(number: int) -> int:
        if number == 1:
            started.set()
        if number == 2:
            raise DecodeError("damaged image", "here")
        return number

    results = prefetch_map(work, range(4), threads=1, depth=2)
    assert next(results) == 0
    assert started.wait(10)
    assert next(results) == 1
    with pytest.raises(DecodeError, match="here"):
        next(results)


def test_prefetch_makes_items_before_they_are_needed() -> None:
    made, third = count(), Event()

    def source() -> Iterator[int]:
        while (number := next(made)) < 10:
            if number == 3:
                third.set()
            if number == 6:
                raise DecodeError("damaged image", "here")
            yield number

    items = prefetch(source(), depth=3)
    assert next(items) == 0
    assert third.wait(10)  # while nobody asks
    assert next(made) == 4
    assert [next(items) for _ in range(4)] == [1, 2, 3, 5]
    with pytest.raises(DecodeError, match="here"):
        next(items)
    assert list(prefetch(range(5), depth=9)) == list(range(5))
