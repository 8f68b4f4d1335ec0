"""Batches of waiting items: none waits for others, each gets its own result, crashes are
isolated."""

import asyncio
from collections.abc import Coroutine, Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.service.batcher import Batcher, PoisonedItem, ReplicaLost


class Doubling:
    """Doubles numbers once `gate` opens; records its batches."""

    def __init__(self, gated: bool = False) -> None:
        self.batches: list[list[int]] = []
        self.gate = asyncio.Event()
        if not gated:
            self.gate.set()

    async def __call__(self, items: Sequence[int]) -> list[int]:
        self.batches.append(list(items))
        await self.gate.wait()
        return [2 * item for item in items]


def run(main: Coroutine[Any, Any, None]) -> None:
    asyncio.run(asyncio.wait_for(main, 10))


@given(count=st.integers(1, 40), largest=st.integers(1, 9), concurrency=st.integers(1, 3))
def test_batcher_returns_own_results_in_arrival_order(
    count: int, largest: int, concurrency: int
) -> None:
    async def main() -> None:
        double, sizes = Doubling(), list[int]()
        batcher = Batcher(double, max_batch=largest, concurrency=concurrency, on_batch=sizes.append)
        found = await asyncio.gather(*(batcher.submit(number) for number in range(count)))
        assert found == [2 * number for number in range(count)]
        assert [number for batch in double.batches for number in batch] == list(range(count))
        assert max(sizes) <= largest
        assert sizes == [len(batch) for batch in double.batches]
        assert batcher.waiting == 0

    run(main())


def test_batcher_lone_item_does_not_wait() -> None:
    async def main() -> None:
        double = Doubling(gated=True)
        batcher = Batcher(double, max_batch=8)
        tasks = [asyncio.create_task(batcher.submit(number)) for number in range(6)]
        await asyncio.sleep(0.01)
        assert double.batches == [[0]]
        assert batcher.waiting == 5
        double.gate.set()
        await asyncio.gather(*tasks)
        assert double.batches == [[0], [1, 2, 3, 4, 5]]

    run(main())


def test_batcher_cancelled_item_leaves_queue() -> None:
    async def main() -> None:
        double = Doubling(gated=True)
        batcher = Batcher(double, max_batch=8)
        tasks = [asyncio.create_task(batcher.submit(number)) for number in range(4)]
        await asyncio.sleep(0.01)
        tasks[0].cancel()  # at work
        tasks[2].cancel()  # waiting
        await asyncio.sleep(0.01)
        assert batcher.waiting == 2
        double.gate.set()
        assert await tasks[1] == 2
        assert await tasks[3] == 6
        assert double.batches == [[0], [1, 3]]

    run(main())


def test_batcher_error_stays_within_its_batch() -> None:
    async def main() -> None:
        async def work(items: Sequence[int]) -> list[int]:
            if 1 in items:
                raise ZeroDivisionError
            return list(items)

        batcher = Batcher(work, max_batch=2)
        found = await asyncio.gather(
            *(batcher.submit(number) for number in (0, 1, 2, 3)), return_exceptions=True
        )
        assert [isinstance(one, ZeroDivisionError) for one in found] == [False, True, True, False]

    run(main())


def test_batcher_lost_batch_is_retried_item_by_item() -> None:
    async def main() -> None:
        async def work(items: Sequence[int]) -> list[int]:
            await asyncio.sleep(0)
            if 13 in items:
                raise ReplicaLost("the worker has died")
            return [2 * item for item in items]

        batcher = Batcher(work, max_batch=8)
        found = await asyncio.gather(
            *(batcher.submit(number) for number in (1, 2, 13, 4)), return_exceptions=True
        )
        assert [found[0], found[1], found[3]] == [2, 4, 8]
        assert isinstance(found[2], PoisonedItem)
        assert await batcher.submit(5) == 10

    run(main())


def test_batcher_retry_after_grows_with_queue() -> None:
    async def main() -> None:
        double = Doubling(gated=True)
        batcher = Batcher(double, max_batch=2)
        assert batcher.retry_after_estimate_s == 1
        tasks = [asyncio.create_task(batcher.submit(number)) for number in range(9)]
        await asyncio.sleep(0.01)
        assert (
            batcher.retry_after_estimate_s == 5
        )  # four batches of a guessed second each wait behind the one at work
        tasks += [asyncio.create_task(batcher.submit(number)) for number in range(300)]
        await asyncio.sleep(0.01)
        assert batcher.retry_after_estimate_s == 60
        double.gate.set()
        await asyncio.gather(*tasks)

    run(main())


def test_batcher_too_few_results_raise() -> None:
    async def main() -> None:
        async def work(items: Sequence[int]) -> list[int]:
            return []

        with pytest.raises(ValueError, match="shorter"):
            await Batcher(work, max_batch=2).submit(1)

    run(main())
