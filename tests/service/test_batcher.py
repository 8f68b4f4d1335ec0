"""Batches of what waits: nothing waits for company, nobody's answer is another's, and one that
kills is told from the rest.
"""

import asyncio
from collections.abc import Coroutine, Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.service.batcher import Batcher, PoisonedItem, ReplicaLost


class Doubling:
    """Doubles numbers, `gates` deciding when; remembers its batches."""

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
def test_everyone_gets_their_own_answer_in_batches_in_order_of_arrival(
    count: int, largest: int, concurrency: int
) -> None:
    async def main() -> None:
        double, sizes = Doubling(), list[int]()
        batcher = Batcher(double, largest=largest, concurrency=concurrency, on_batch=sizes.append)
        found = await asyncio.gather(*(batcher.ask(number) for number in range(count)))
        assert found == [2 * number for number in range(count)]
        assert [number for batch in double.batches for number in batch] == list(range(count))
        assert max(sizes) <= largest
        assert sizes == [len(batch) for batch in double.batches]
        assert batcher.waiting == 0

    run(main())


def test_a_lone_item_is_computed_at_once_and_what_arrives_meanwhile_is_one_batch() -> None:
    async def main() -> None:
        double = Doubling(gated=True)
        batcher = Batcher(double, largest=8)
        asked = [asyncio.create_task(batcher.ask(number)) for number in range(6)]
        await asyncio.sleep(0.01)
        assert double.batches == [[0]]
        assert batcher.waiting == 5
        double.gate.set()
        await asyncio.gather(*asked)
        assert double.batches == [[0], [1, 2, 3, 4, 5]]

    run(main())


def test_whoever_goes_away_leaves_the_queue() -> None:
    async def main() -> None:
        double = Doubling(gated=True)
        batcher = Batcher(double, largest=8)
        asked = [asyncio.create_task(batcher.ask(number)) for number in range(4)]
        await asyncio.sleep(0.01)
        asked[0].cancel()  # at work
        asked[2].cancel()  # waiting
        await asyncio.sleep(0.01)
        assert batcher.waiting == 2
        double.gate.set()
        assert await asked[1] == 2
        assert await asked[3] == 6
        assert double.batches == [[0], [1, 3]]

    run(main())


def test_a_failed_batch_tells_everyone_in_it_and_nobody_else() -> None:
    async def main() -> None:
        async def work(items: Sequence[int]) -> list[int]:
            if 1 in items:
                raise ZeroDivisionError
            return list(items)

        batcher = Batcher(work, largest=2)
        found = await asyncio.gather(
            *(batcher.ask(number) for number in (0, 1, 2, 3)), return_exceptions=True
        )
        assert [isinstance(one, ZeroDivisionError) for one in found] == [False, True, True, False]

    run(main())


def test_of_a_batch_that_is_lost_only_the_one_that_kills_has_no_answer() -> None:
    async def main() -> None:
        async def work(items: Sequence[int]) -> list[int]:
            await asyncio.sleep(0)
            if 13 in items:
                raise ReplicaLost("the worker has died")
            return [2 * item for item in items]

        batcher = Batcher(work, largest=8)
        found = await asyncio.gather(
            *(batcher.ask(number) for number in (1, 2, 13, 4)), return_exceptions=True
        )
        assert [found[0], found[1], found[3]] == [2, 4, 8]
        assert isinstance(found[2], PoisonedItem)
        assert await batcher.ask(5) == 10

    run(main())


def test_the_seconds_to_wait_grow_with_the_queue_and_stay_between_1_and_60() -> None:
    async def main() -> None:
        double = Doubling(gated=True)
        batcher = Batcher(double, largest=2)
        assert batcher.retry_after_estimate_s == 1
        asked = [asyncio.create_task(batcher.ask(number)) for number in range(9)]
        await asyncio.sleep(0.01)
        assert (
            batcher.retry_after_estimate_s == 5
        )  # four batches of a guessed second each wait behind the one at work
        asked += [asyncio.create_task(batcher.ask(number)) for number in range(300)]
        await asyncio.sleep(0.01)
        assert batcher.retry_after_estimate_s == 60
        double.gate.set()
        await asyncio.gather(*asked)

    run(main())


def test_too_few_results_are_an_error_and_no_ones_wait_for_ever() -> None:
    async def main() -> None:
        async def work(items: Sequence[int]) -> list[int]:
            return []

        with pytest.raises(ValueError, match="shorter"):
            await Batcher(work, largest=2).ask(1)

    run(main())
