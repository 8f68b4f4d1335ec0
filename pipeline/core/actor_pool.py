"""A pool of Ray actors with retries: items of a dead actor are rescheduled on another.

In: how to create an actor, and items. Out: each item once, with its result, or skipped with the
reason. Actors that still wait for resources of the cluster do not delay those that have started. An
actor has the methods `start()`, called once and first, and `work(item)`, of which `in_flight` run
at once.
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
"Deaths of actors over one item after which it is skipped."
MAX_SKIPPED_BEFORE_SUCCESS = 5
"Items that may be skipped before any succeeded; at this number the fault is not theirs."
SECONDS_UNTIL_NOTICE = 15.0
"Without any worker, until the user is told that the pool waits for one."


@dataclass(frozen=True, kw_only=True)
class PoolConfig:
    """The settings of an actor pool."""

    create_actor: Callable[[], Any]
    "Asks Ray for a new actor."
    size: int
    "Actors that are asked for."
    resources: str
    "What an actor asks of the cluster, for messages."
    in_flight: int = 2
    "Items that an actor has at once; its `max_concurrency`."
    skip_on: tuple[type[Exception], ...] = ()
    "Raised by `work` over an item that no retry helps: it is skipped at once."
    fatal: tuple[type[Exception], ...] = ()
    "Raised by `work` if every item would fail alike: the pool raises it."
    patience: float = 600.0
    "Seconds without any worker until NoWorkerStarted."
    notify: Callable[[str], None] = lambda text: None
    "Called with remarks for the user meanwhile."


@dataclass(frozen=True, kw_only=True)
class Skipped:
    """Why an item has no result."""

    reason: str
    "Short and countable."
    found: str
    "The last error."


class NoWorkerStarted(RuntimeError):
    """No actor started in time."""


class PoolFailed(RuntimeError):
    """Actors start and fail, whatever the item."""


@dataclass(eq=False)
class _Worker:
    actor: Any
    created: Any
    "Reference to its first call, which ends once the actor exists."
    starting: Any
    "Reference to the end of `start`; None once it has ended."
    since: float = 0.0
    "When it began to work."
    calls: dict[Any, Any] = field(default_factory=dict)
    "Reference -> item."
    exclusive: bool = False
    "Whether the item it has must be the only one."


class ActorPool:
    """A fixed number of actors, replaced as they die."""

    def __init__(self, config: PoolConfig) -> None:
        self.config = config
        self.seconds = 0.0
        "Sum over the actors of the time they were ready or worked; known when the work is done."
        self._workers: list[_Worker] = []
        self._pending: deque[Any] = deque()
        # Items that an actor had when it died. Each is retried alone, so that an item that crashes
        # workers is told apart from its neighbours.
        self._suspects: deque[Any] = deque()
        self._failures: Counter[Any] = Counter()
        self._failed_starts = self._succeeded = self._skipped = 0
        self._notified = set[str]()

    @property
    def ready_workers(self) -> int:
        """Actors that have started."""
        return sum(worker.starting is None for worker in self._workers)

    def work(self, items: Iterable[Any]) -> Iterator[tuple[Any, Any]]:
        """Each item with its result or Skipped, as they finish. Items are hashable.

        Raises NoWorkerStarted, PoolFailed, and the errors that `fatal` names.
        """
        self._pending.extend(items)
        try:
            for _ in range(min(self.config.size, len(self._pending))):
                self._add_worker()
            while self._pending or self._suspects or any(worker.calls for worker in self._workers):
                self._submit()
                yield from self._handle_result(*self._next_finished())
        finally:
            for worker in list(self._workers):
                self._remove_worker(worker)

    def _add_worker(self) -> None:
        actor = self.config.create_actor()
        self._workers.append(_Worker(actor, actor.__ray_ready__.remote(), actor.start.remote()))

    def _remove_worker(self, worker: _Worker) -> None:
        self._workers.remove(worker)
        if worker.starting is None:
            self.seconds += time.monotonic() - worker.since
            cluster.stop_actor(worker.actor, worker.created)
        else:
            cluster.stop_actor(worker.actor, worker.created, worker.starting)

    def _submit(self) -> None:
        """Give items to the workers that have room: suspects to idle ones, alone; others to the
        least busy."""
        while self._pending or self._suspects:
            free = [worker for worker in self._workers if self._has_room(worker)]
            idle = next((worker for worker in free if not worker.calls), None)
            if self._suspects and idle:
                worker, item, idle.exclusive = idle, self._suspects.popleft(), True
            elif self._pending and free:
                worker = min(free, key=lambda one: len(one.calls))
                item = self._pending.popleft()
            else:
                return
            worker.calls[worker.actor.work.remote(item)] = item

    def _has_room(self, worker: _Worker) -> bool:
        started = worker.starting is None and not worker.exclusive
        return started and len(worker.calls) < self.config.in_flight

    def _next_finished(self) -> tuple[_Worker, Any]:
        """The next call that has ended, and the worker that ran it."""
        began, notified = time.monotonic(), False
        while True:
            owner = {ref: worker for worker in self._workers for ref in worker.calls}
            owner |= {w.starting: w for w in self._workers if w.starting is not None}
            ended, _ = ray.wait(list(owner), num_returns=1, timeout=1.0)
            if ended:
                return owner[ended[0]], ended[0]
            waited = time.monotonic() - began
            if self.ready_workers or waited < min(SECONDS_UNTIL_NOTICE, self.config.patience):
                continue
            asked = f"each asks for {self.config.resources}"
            state = f"no worker has started for {waited:.0f} s; {asked}"
            if waited > self.config.patience:
                raise NoWorkerStarted(state)
            if not notified:
                self.config.notify(f"{state}; waiting for up to {self.config.patience:.0f} s")
                notified = True

    def _handle_result(self, worker: _Worker, ref: Any) -> Iterator[tuple[Any, Any]]:
        result, error = _outcome(ref)
        if ref is worker.starting:
            self._handle_start(worker, result, error)
            return
        item = worker.calls.pop(ref)
        worker.exclusive = False
        if error is None:
            self._succeeded += 1
            yield item, result
        elif isinstance(error, self.config.fatal):
            raise error
        elif isinstance(error, self.config.skip_on):
            yield item, Skipped(reason="unusable", found=str(error))
        else:
            # If the actor died, any of its items may be the cause. If it raised, the item is known;
            # the others start again elsewhere, because an unforeseen error may have left the actor
            # in any state.
            others = list(worker.calls.values())
            blamed = [item, *others] if isinstance(error, RayError) else [item]
            self._pending.extendleft(other for other in others if other not in blamed)
            self._remove_worker(worker)
            yield from self._retry_or_skip(blamed, error)
            if self._pending or self._suspects:
                self._add_worker()

    def _handle_start(
        self, worker: _Worker, remarks: list[str] | None, error: BaseException | None
    ) -> None:
        if error is None:
            for remark in remarks or []:
                if remark not in self._notified:  # every worker makes the same remarks
                    self._notified.add(remark)
                    self.config.notify(remark)
            worker.starting, worker.since, self._failed_starts = None, time.monotonic(), 0
            return
        self._failed_starts += 1
        self._remove_worker(worker)
        hopeless = not isinstance(error, RayError) or getattr(error, "actor_init_failed", False)
        if hopeless or self._failed_starts == MAX_ATTEMPTS:
            raise PoolFailed(f"a worker cannot start: {_error_line(error)}") from error
        self._add_worker()

    def _retry_or_skip(
        self, items: list[Any], error: BaseException
    ) -> Iterator[tuple[Any, Skipped]]:
        for item in items:
            self._failures[item] += 1
            if self._failures[item] < MAX_ATTEMPTS:
                self._suspects.append(item)
                continue
            self._skipped += 1
            yield item, Skipped(reason=f"lost {MAX_ATTEMPTS} workers", found=_error_line(error))
        if self._skipped >= MAX_SKIPPED_BEFORE_SUCCESS and not self._succeeded:
            raise PoolFailed(
                f"{self._skipped} items lost {MAX_ATTEMPTS} workers each and none was done: "
                f"{_error_line(error)}"
            ) from error


def _outcome(ref: Any) -> tuple[Any, BaseException | None]:
    """The result of a call, or its error: a RayError if its actor was lost, else the one raised."""
    try:
        return ray.get(ref), None
    except RayTaskError as error:
        return None, error.cause or error
    except RayError as error:
        return None, error


def _error_line(error: BaseException) -> str:
    """An error in one line: its first, or the last line of the traceback that Ray reports if an
    actor cannot be created."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    line = lines[-1 if getattr(error, "actor_init_failed", False) else 0] if lines else ""
    return f"{type(error).__name__}: {line}" if line else type(error).__name__
