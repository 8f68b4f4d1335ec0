"""Requests that arrive one by one -> batches for whoever computes: what arrives during one batch is
the next one.

Nothing waits for company: a lone request is computed at once, and under load the batches fill by
themselves.
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
    """Whoever computed a batch is gone, and the batch with it; another will take its place."""


class PoisonedItem(Exception):
    """An item that was in the hands of two who are gone: of a batch first, then alone. It is not
    tried again.
    """


class Batcher(Generic[Item, Result]):
    """Asks `work` for the results of up to `largest` items at once, with `concurrency` batches at work
    at a time.

    `work` gives one result per item, in order. A batch that raises Gone is tried again item by item, so that one that kills
    is told from those beside it.
    """

    def __init__(
        self,
        work: Callable[[Sequence[Item]], Awaitable[Sequence[Result]]],
        *,
        largest: int,
        concurrency: int = 1,
        on_batch: Callable[[int], None] = lambda size: None,
    ) -> None:
        """`on_batch` is called with the size of each batch that begins."""
        self._work, self._largest, self._abreast, self._on_batch = (
            work,
            largest,
            concurrency,
            on_batch,
        )
        self._waiting: dict[asyncio.Future[Result], Item] = {}  # in the order of their coming
        self._at_work: set[asyncio.Task[None]] = set()
        self._seconds = 1.0  # of the last batch; until there was one, a guess

    @property
    def waiting(self) -> int:
        """Items that no batch has taken yet."""
        return len(self._waiting)

    @property
    def expected_queue_s(self) -> float:
        """Seconds until a batch takes whoever comes now, about: none where nobody waits."""
        return len(self._waiting) / (self._largest * self._abreast) * self._seconds

    @property
    def retry_after_estimate_s(self) -> int:
        """Whole seconds after which those who wait now will be answered, about; 1 to 60."""
        return min(60, max(1, math.ceil(self.expected_queue_s + self._seconds)))

    async def ask(self, item: Item) -> Result:
        """The result of one item. Cancelled, it leaves the queue.

        Raises what `work` raises, and Alone.
        """
        future: asyncio.Future[Result] = asyncio.get_running_loop().create_future()
        self._waiting[future] = item
        self._begin()
        try:
            return await future
        finally:
            self._waiting.pop(future, None)  # still there where whoever asked has gone away

    def _begin(self) -> None:
        while self._waiting and len(self._at_work) < self._abreast:
            batch = {
                future: self._waiting.pop(future)
                for future in list(islice(self._waiting, self._largest))
            }
            self._on_batch(len(batch))
            task = asyncio.create_task(self._run(batch))
            self._at_work.add(task)
            task.add_done_callback(self._ended)

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._at_work.discard(task)
        self._begin()

    async def _run(self, batch: "dict[asyncio.Future[Result], Item]") -> None:
        began = time.monotonic()
        try:
            await self._settle(batch)
        except ReplicaLost:
            for future, item in batch.items():
                if future.done():  # whoever asked has gone away
                    continue
                try:
                    await self._settle({future: item})
                except ReplicaLost as error:
                    if not future.done():
                        future.set_exception(PoisonedItem(str(error)))
        finally:
            self._seconds = time.monotonic() - began

    async def _settle(self, batch: "dict[asyncio.Future[Result], Item]") -> None:
        """Give every future its result, or the failure of the batch. Raises Gone alone."""
        try:
            settled = list(zip(batch, await self._work(list(batch.values())), strict=True))
        except ReplicaLost:
            raise
        except Exception as error:
            for future in batch:
                if not future.done():
                    future.set_exception(error)
            return
        for future, result in settled:
            if not future.done():
                future.set_result(result)
