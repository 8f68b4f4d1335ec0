"""Ray actors that work off a list of items: what one leaves undone when it dies, another takes up.

In: how to hire an actor, and items. Out: each item once, with its result, or set aside with the
reason. Actors that are still waiting for a place in the cluster keep nobody from working. An actor
has the methods `start()`, called once and first, and `work(item)`, of which `in_flight` run at
once.
"""

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import ray
from ray.exceptions import RayError, RayTaskError

from pipeline.core import cluster

MAX_ATTEMPTS = 3
"Deaths over one item after which it is not tried again."
MAX_SKIPPED_BEFORE_SUCCESS = 5
"Items that may be set aside before any was done; then the fault is not theirs."
SECONDS_UNTIL_NOTICE = 15.0
"Without a worker, until it is said that they are waited for."


@dataclass(frozen=True, kw_only=True)
class PoolConfig:
    """How a crew works."""

    create_actor: Callable[[], Any]
    "Asks Ray for a new actor."
    size: int
    "Actors that are asked for."
    resources: str
    "What an actor asks of the cluster, for messages."
    in_flight: int = 2
    "Items that an actor has at once; its `max_concurrency`."
    refusals: tuple[type[Exception], ...] = ()
    "What `work` raises of an item that is no use trying again: it is set aside at once."
    fatal: tuple[type[Exception], ...] = ()
    "What `work` raises when all items would fail alike: it is raised by the crew."
    patience: float = 600.0
    "Seconds without any worker until NobodyCame."
    say: Callable[[str], None] = lambda text: None
    "Told what a person should know meanwhile."


@dataclass(frozen=True, kw_only=True)
class Skipped:
    """Why an item was not done."""

    reason: str
    "Short and countable."
    found: str
    "What was seen last."


class NoWorkerStarted(RuntimeError):
    """No actor started in time."""


class PoolFailed(RuntimeError):
    """Actors start and fail, whatever the item."""


@dataclass(eq=False)
class _Worker:
    actor: Any
    created: Any
    "Reference to its first call, which ends as soon as it lives."
    starting: Any
    "Reference to the end of `start`; None once it is there."
    since: float = 0.0
    "When it began to work."
    calls: dict[Any, Any] = field(default_factory=dict)
    "Reference -> item."
    alone: bool = False
    "Whether the item it has must be the only one."


class ActorPool:
    """So many actors, replaced as they die."""

    def __init__(self, terms: PoolConfig) -> None:
        self.terms = terms
        self.seconds = 0.0
        "That actors stood ready or worked, all together; known when the work is done."
        self._workers: list[_Worker] = []
        self._fresh: deque[Any] = deque()
        # Items that were in an actor's hands when it died. Each is tried alone, so that it is known
        # whose fault a death is.
        self._suspects: deque[Any] = deque()
        self._strikes: Counter[Any] = Counter()
        self._failed_starts = self._done = self._lost = 0
        self._told = set[str]()

    @property
    def working(self) -> int:
        """Actors that have started."""
        return sum(worker.starting is None for worker in self._workers)

    def work(self, items: Iterable[Any]) -> Iterator[tuple[Any, Any]]:
        """Each item with its result or SetAside, as they are done. Items are hashable.

        Raises NobodyCame, CannotWork, and what `fatal` names.
        """
        self._fresh.extend(items)
        try:
            for _ in range(min(self.terms.size, len(self._fresh))):
                self._hire()
            while self._fresh or self._suspects or any(worker.calls for worker in self._workers):
                self._hand_out()
                yield from self._settle(*self._next())
        finally:
            for worker in list(self._workers):
                self._dismiss(worker)

    def _hire(self) -> None:
        actor = self.terms.create_actor()
        self._workers.append(_Worker(actor, actor.__ray_ready__.remote(), actor.start.remote()))

    def _dismiss(self, worker: _Worker) -> None:
        self._workers.remove(worker)
        if worker.starting is None:
            self.seconds += time.monotonic() - worker.since
            cluster.stop_actor(worker.actor, worker.created)
        else:
            cluster.stop_actor(worker.actor, worker.created, worker.starting)

    def _hand_out(self) -> None:
        while self._fresh or self._suspects:
            room = self.terms.in_flight
            free = [
                w
                for w in self._workers
                if w.starting is None and not w.alone and len(w.calls) < room
            ]
            idle = next((worker for worker in free if not worker.calls), None)
            if self._suspects and idle:
                worker, item, idle.alone = idle, self._suspects.popleft(), True
            elif self._fresh and free:
                worker, item = min(free, key=lambda one: len(one.calls)), self._fresh.popleft()
            else:
                return
            worker.calls[worker.actor.work.remote(item)] = item

    def _next(self) -> tuple[_Worker, Any]:
        """The next call that has ended, and whose it was."""
        began, told = time.monotonic(), False
        while True:
            owner = {ref: worker for worker in self._workers for ref in worker.calls}
            owner |= {
                worker.starting: worker for worker in self._workers if worker.starting is not None
            }
            ended, _ = ray.wait(list(owner), num_returns=1, timeout=1.0)
            if ended:
                return owner[ended[0]], ended[0]
            waited = time.monotonic() - began
            if self.working or waited < min(SECONDS_UNTIL_NOTICE, self.terms.patience):
                continue
            words = (
                f"no worker has started for {waited:.0f} s; each asks for {self.terms.resources}"
            )
            if waited > self.terms.patience:
                raise NoWorkerStarted(words)
            if not told:
                self.terms.say(f"{words}; waiting for up to {self.terms.patience:.0f} s")
                told = True

    def _settle(self, worker: _Worker, ref: Any) -> Iterator[tuple[Any, Any]]:
        result, error = _outcome(ref)
        if ref is worker.starting:
            self._settle_start(worker, result, error)
            return
        item = worker.calls.pop(ref)
        worker.alone = False
        if error is None:
            self._done += 1
            yield item, result
        elif isinstance(error, self.terms.fatal):
            raise error
        elif isinstance(error, self.terms.refusals):
            yield item, Skipped(reason="unusable", found=str(error))
        else:
            # Of an actor that died nobody knows over which item; of one that raised it is known,
            # and what else it had is begun again elsewhere, because an error nobody foresaw may
            # have left it in any state.
            others = list(worker.calls.values())
            blamed = [item, *others] if isinstance(error, RayError) else [item]
            self._fresh.extendleft(other for other in others if other not in blamed)
            self._dismiss(worker)
            yield from self._blame(blamed, error)
            if self._fresh or self._suspects:
                self._hire()

    def _settle_start(
        self, worker: _Worker, remarks: list[str] | None, error: BaseException | None
    ) -> None:
        if error is None:
            for remark in remarks or []:
                if remark not in self._told:  # workers of one kind say the same
                    self._told.add(remark)
                    self.terms.say(remark)
            worker.starting, worker.since, self._failed_starts = None, time.monotonic(), 0
            return
        self._failed_starts += 1
        self._dismiss(worker)
        hopeless = not isinstance(error, RayError) or getattr(error, "actor_init_failed", False)
        if hopeless or self._failed_starts == MAX_ATTEMPTS:
            raise PoolFailed(f"a worker cannot start: {_error_line(error)}") from error
        self._hire()

    def _blame(self, items: list[Any], error: BaseException) -> Iterator[tuple[Any, Skipped]]:
        for item in items:
            self._strikes[item] += 1
            if self._strikes[item] < MAX_ATTEMPTS:
                self._suspects.append(item)
                continue
            self._lost += 1
            yield item, Skipped(reason=f"lost {MAX_ATTEMPTS} workers", found=_error_line(error))
        if self._lost >= MAX_SKIPPED_BEFORE_SUCCESS and not self._done:
            raise PoolFailed(
                f"{self._lost} items lost {MAX_ATTEMPTS} workers each and none was done: {_error_line(error)}"
            ) from error


def _outcome(ref: Any) -> tuple[Any, BaseException | None]:
    """What a call gave, or what it raised: its own error, or a RayError where its actor was lost."""
    try:
        return ray.get(ref), None
    except RayTaskError as error:
        return None, error.cause or error
    except RayError as error:
        return None, error


def _error_line(error: BaseException) -> str:
    """An error in one line: its first, or the last of the traceback that Ray writes where an actor
    cannot be made.
    """
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    line = lines[-1 if getattr(error, "actor_init_failed", False) else 0] if lines else ""
    return f"{type(error).__name__}: {line}" if line else type(error).__name__
