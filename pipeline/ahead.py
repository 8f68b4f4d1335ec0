"""Work done by threads before it is asked for, in order and never too far ahead."""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

In = TypeVar("In")
Out = TypeVar("Out")
Item = TypeVar("Item")


def ahead(function: Callable[[In], Out], items: Iterable[In], threads: int, depth: int) -> Iterator[Out]:
    """`map` by threads, in order, at most `depth` items ahead of the consumer. Decoding releases the GIL."""
    with ThreadPoolExecutor(threads) as pool:
        waiting: deque[Future[Out]] = deque()
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) > depth:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)


def ready(items: Iterable[Item], depth: int) -> Generator[Item, None, None]:
    """The items in order, made by a thread of their own, `depth` of them before they are asked for."""
    source, end = iter(items), object()
    with ThreadPoolExecutor(1) as pool:
        waiting: deque[Future[Any]] = deque(pool.submit(next, source, end) for _ in range(depth))
        try:
            while (item := waiting.popleft().result()) is not end:
                waiting.append(pool.submit(next, source, end))
                yield item
        finally:
            pool.shutdown(cancel_futures=True)
