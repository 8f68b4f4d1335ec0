"""Requests that arrive one by one -> batches: all that arrive during one batch form the next one.

A request never waits for others: a lone one is computed at once, and under load the batches fill
up by themselves.
"""

import asyncio
import math
import time
from collections.abc import Awaitable, Callable, Sequence
from itertools import islice
from typing import Generic, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


class ReplicaLost(Exception):
    """The replica that computed a batch died, and the batch with it; another replica replaces
    it."""


class PoisonedItem(Exception):
    """An item lost with two replicas: first in a batch, then alone. It is not tried again."""


class Batcher(Generic[Item, Result]):
    """Calls `work` with batches of up to `max_batch` items, `concurrency` batches at a time.

    `work` returns one result per item, in order. The items of a batch that raises ReplicaLost are
    tried again one at a time, so that an item that crashes replicas is told apart from its
    neighbours.
    """

    def __init__(
        self,
        work: Callable[[Sequence[Item]], Awaitable[Sequence[Result]]],
        *,
        max_batch: int,
        concurrency: int = 1,
        on_batch: Callable[[int], None] = lambda size: None,
    ) -> None:
        """`on_batch` is called with the size of each batch that begins."""
        self._work, self._on_batch = work, on_batch
        self._max_batch, self._concurrency = max_batch, concurrency
        self._waiting: dict[asyncio.Future[Result], Item] = {}  # in order of arrival
        self._running: set[asyncio.Task[None]] = set()
        self._batch_s = 1.0  # duration of the last batch; a guess until there was one

    @property
    def waiting(self) -> int:
        """Items that no batch has taken yet."""
        return len(self._waiting)

    @property
    def expected_queue_s(self) -> float:
        """Estimated seconds until a batch takes an item that arrives now; 0 for an empty queue."""
        return len(self._waiting) / (self._max_batch * self._concurrency) * self._batch_s

    @property
    def retry_after_estimate_s(self) -> int:
        """Estimated whole seconds until all waiting items are answered; 1 to 60."""
        return min(60, max(1, math.ceil(self.expected_queue_s + self._batch_s)))

    async def submit(self, item: Item) -> Result:
        """The result of one item. If cancelled, the item leaves the queue.

        Raises what `work` raises, and PoisonedItem.
        """
        future: asyncio.Future[Result] = asyncio.get_running_loop().create_future()
        self._waiting[future] = item
        self._start_batches()
        try:
            return await future
        finally:
            self._waiting.pop(future, None)  # still there if the caller was cancelled

    def _start_batches(self) -> None:
        while self._waiting and len(self._running) < self._concurrency:
            futures = list(islice(self._waiting, self._max_batch))
            batch = {future: self._waiting.pop(future) for future in futures}
            self._on_batch(len(batch))
            task = asyncio.create_task(self._run(batch))
            self._running.add(task)
            task.add_done_callback(self._after_batch)

    def _after_batch(self, task: asyncio.Task[None]) -> None:
        self._running.discard(task)
        self._start_batches()

    async def _run(self, batch: "dict[asyncio.Future[Result], Item]") -> None:
        began = time.monotonic()
        try:
            await self._compute(batch)
        except ReplicaLost:
            for future, item in batch.items():
                if future.done():  # the caller was cancelled
                    continue
                try:
                    await self._compute({future: item})
                except ReplicaLost as error:
                    if not future.done():
                        future.set_exception(PoisonedItem(str(error)))
        finally:
            self._batch_s = time.monotonic() - began

    async def _compute(self, batch: "dict[asyncio.Future[Result], Item]") -> None:
        """Set the result of every future, or the failure of the batch. Raises only ReplicaLost."""
        try:
            results = await self._work(list(batch.values()))
            resolved = list(zip(batch, results, strict=True))
        except ReplicaLost:
            raise
        except Exception as error:
            for future in batch:
                if not future.done():
                    future.set_exception(error)
            return
        for future, result in resolved:
            if not future.done():
                future.set_result(result)
