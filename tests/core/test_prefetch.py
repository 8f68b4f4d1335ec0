"""Prefetching keeps the order, stays within its depth, and raises errors in their place."""

from collections.abc import Iterator
from itertools import count
from threading import Event, get_ident

import pytest

from pipeline.core.prefetch import items_together, prefetch, prefetch_map
from pipeline.images.decode import DecodeError


def test_prefetch_map_keeps_order_within_its_depth() -> None:
    drawn = count()
    numbers: Iterator[int] = (next(drawn) for _ in range(100))
    results = prefetch_map(lambda number: number * number, numbers, threads=3, depth=5)
    assert [next(results) for _ in range(4)] == [0, 1, 4, 9]
    assert next(drawn) <= 4 + 5
    results.close()  # type: ignore[attr-defined]


@pytest.mark.parametrize("together", [1, 3, 8])
def test_prefetch_map_does_items_together(together: int) -> None:
    drawn = count()
    numbers: Iterator[int] = (next(drawn) for _ in range(100))
    results = prefetch_map(lambda number: number * number, numbers, 2, 8, together)
    assert [next(results) for _ in range(10)] == [number**2 for number in range(10)]
    assert next(drawn) <= 10 + 8 + together
    assert len(list(results)) == 100 - 10
    threads: set[int] = set()
    list(prefetch_map(lambda _: threads.add(get_ident()), range(20), 2, 8, together))
    assert len(threads) <= 2


@pytest.mark.parametrize("threads", [1, 2, 16, 1000])
def test_items_together_leave_work_for_all_threads(threads: int) -> None:
    for depth in (1, 4, 32, 128):
        together = items_together(threads, depth)
        assert 1 <= together <= 8
        assert together == 1 or depth // together >= 2 * threads


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
