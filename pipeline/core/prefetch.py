"""Work done by threads before it is asked for, in order and never too far ahead.

Threads are begun for one use, or given: whoever begins this a thousand times over keeps its own,
for each new thread may get a heap of its own from the C library, and memory grows until there are
eight heaps a core.
"""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import Any, TypeVar

In = TypeVar("In")
Out = TypeVar("Out")
Item = TypeVar("Item")


def prefetch_map(
    function: Callable[[In], Out], items: Iterable[In], threads: int | Executor, depth: int
) -> Iterator[Out]:
    """`map` by threads, in order, at most `depth` items ahead of the consumer. Decoding releases
    the GIL.
    """
    with _executor(threads) as (pool, waiting):
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) > depth:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def prefetch(
    items: Iterable[Item], depth: int, thread: Executor | None = None
) -> Generator[Item, None, None]:
    """The items in order, made by a thread of their own, `depth` of them before they are asked for.

    `thread` must be a single one, that nobody else uses meanwhile.
    """
    source, end = iter(items), object()
    with _executor(thread or 1) as (pool, waiting):
        waiting.extend(pool.submit(next, source, end) for _ in range(depth))
        while (item := waiting.popleft().result()) is not end:
            waiting.append(pool.submit(next, source, end))
            yield item


@contextmanager
def _executor(threads: int | Executor) -> Iterator[tuple[Executor, deque[Future[Any]]]]:
    """Threads, and a queue of what they were given: at the end what has not begun is dropped, what
    has is waited for.
    """
    pool = ThreadPoolExecutor(threads) if isinstance(threads, int) else threads
    waiting: deque[Future[Any]] = deque()
    try:
        yield pool, waiting
    finally:
        wait([future for future in waiting if not future.cancel()])
        if pool is not threads:
            pool.shutdown()
