"""Ray as this project uses it: one way to connect, bounded parallel calls, and how workers are
placed.

In: the nodes of a cluster as they are, and what a stage asks for. Out: a `Placement` (a plain
function of the two; only `nodes` asks Ray), and results of calls with a bounded number in flight.
"""

import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

import ray
from ray.exceptions import RayTaskError

from pipeline.core.errors import Incomplete
from pipeline.core.progress import console

_Item = TypeVar("_Item")

CORES_PER_WORKER = 8
"Of a worker without a GPU, unless the user chooses: a network's threads gain little beyond."

START_S = 10.0
"About what a Ray of this machine takes to start, on quiet cores."


@dataclass(frozen=True, kw_only=True)
class Node:
    """One machine of a cluster."""

    cpus: float
    gpus: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Placement:
    """The workers that are asked of Ray."""

    workers: int
    cpus: int
    "Of each worker."
    gpus: float
    "Of each worker."

    def __str__(self) -> str:
        return f"{self.cpus} CPUs and {self.gpus:g} GPUs" if self.gpus else f"{self.cpus} CPUs"


def tasks_pay(work_s: float) -> bool:
    """Whether tasks finish what takes this process `work_s` seconds sooner than it would: where a
    cluster is at hand, or there is more to do than on two cores while one starts."""
    named = os.environ.get("RAY_ADDRESS") or "local"
    at_hand = ray.is_initialized() or named != "local" or _noted_address() is not None
    return at_hand or work_s > 2 * START_S


def workers_for(workers: int | None, work_s: float) -> int | None:
    """As many tasks at once as are asked for; 0, this process, where none are asked for and they
    do not pay."""
    return 0 if workers is None and not tasks_pay(work_s) else workers


def connect() -> None:
    """Join the cluster that RAY_ADDRESS names (`ray job submit` sets it) or that `ray start` began
    on this machine, else start one for this process. Idempotent.

    Workers' output stays in Ray's session folder: what a worker reports comes back as a result or
    an exception. Raises Incomplete if no cluster answers and none can be started.
    """
    if ray.is_initialized():
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # Ray's coming default; unset, each init warns.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    # The first task that fails is reported by whoever waits for it; those beside it say the same.
    os.environ.setdefault("RAY_IGNORE_UNHANDLED_ERRORS", "1")
    # A token for a local cluster is what we want, and no news.
    logging.getLogger("ray._private.authentication.authentication_token_setup").setLevel(
        logging.ERROR
    )
    try:
        with _keep_signal_handlers():
            ray.init(_address(), log_to_driver=False, logging_level=logging.WARNING)
    except Exception as error:  # ConnectionError, RuntimeError, ValueError and plain Exception
        address = os.environ.get("RAY_ADDRESS")
        asked = f"at {address}" if address else "on this machine"
        why = str(error).strip().partition("\n")[0] or type(error).__name__
        raise Incomplete(
            f"found no Ray cluster {asked}, and none could be started ({why}); expected one that "
            "answers; see to it, or unset RAY_ADDRESS so that one is started here, and run the "
            "same command again"
        ) from error


def _address() -> str | None:
    """Address for ray.init: None, so that Ray looks for a cluster itself; "local" if it would find
    one that is gone.

    `ray start` writes its address to a file, which outlives a cluster that was killed, and Ray
    waits for that cluster for ever.
    """
    noted = None if os.environ.get("RAY_ADDRESS") else _noted_address()
    if not noted:
        return None
    host, _, port = noted.rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=5).close()
    except (OSError, ValueError):  # the latter: no address
        console.print(
            f"the Ray cluster at {noted} that `ray start` began is gone; one is started for this "
            "run"
        )
        return "local"
    return None


def _noted_address() -> str | None:
    """The address that `ray start` wrote on this machine; None if there is none.

    Read here, because Ray has no public function for it [Ray 2.60, ray/_common/utils.py]. If a
    later Ray keeps it elsewhere, None is returned and Ray looks for itself.
    """
    scratch = os.environ.get("RAY_TMPDIR")
    if scratch is None and sys.platform == "linux":
        scratch = os.environ.get("TMPDIR")
    try:
        return Path(scratch or "/tmp", "ray", "ray_current_cluster").read_text().strip()
    except (OSError, ValueError):
        return None


@contextmanager
def _keep_signal_handlers() -> Iterator[None]:
    """Hold back Ctrl-C until Ray has started, because a half-started Ray cannot be stopped: it
    crashes. A second Ctrl-C interrupts at once.

    Restore the handler of SIGTERM too: Ray's own would end this process by an abort, with a stack
    of its C++ on the terminal, or, while it starts, by a bare exit.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[int] = []

    def hold_back(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if len(received) > 1:
            raise KeyboardInterrupt

    interrupt = signal.signal(signal.SIGINT, hold_back)
    terminate = signal.getsignal(signal.SIGTERM)
    try:
        yield
    except SystemExit:
        if not callable(terminate):
            raise
        terminate(signal.SIGTERM, None)
    finally:
        signal.signal(signal.SIGINT, interrupt)
        if callable(terminate):
            signal.signal(signal.SIGTERM, terminate)
    if received and callable(interrupt):
        interrupt(signal.SIGINT, None)


def cpus() -> int:
    """CPU cores of the whole cluster, at least 1."""
    return max(1, int(_resources().get("CPU", 1)))


def gpus() -> int:
    """GPUs of the whole cluster."""
    return int(_resources().get("GPU", 0))


def nodes() -> list[Node]:
    """The machines of the cluster that are up."""
    found: list[dict[str, Any]] = ray.nodes()  # type: ignore[no-untyped-call]
    up = [node["Resources"] for node in found if node["Alive"]]
    return [Node(cpus=has.get("CPU", 0.0), gpus=has.get("GPU", 0.0)) for has in up]


def _resources() -> dict[str, float]:
    found: dict[str, float] = ray.cluster_resources()  # type: ignore[no-untyped-call]
    return found


def plan_placement(
    nodes: Sequence[Node],
    items: int,
    workers: int | None = None,
    cpus: int | None = None,
    gpus: float | None = None,
) -> Placement:
    """A placement for so many items. None: one worker per GPU if there are any, else one per eight
    cores of a node; and as many cores each as let all of them fit on the nodes, at least 1."""
    if gpus is None:
        gpus = 1.0 if any(node.gpus >= 1 for node in nodes) else 0.0
    if workers is None:
        workers = 0
        for node in nodes:
            own = cpus or (1 if gpus else min(CORES_PER_WORKER, max(1, int(node.cpus))))
            workers += _workers_that_fit(node, own, gpus)
    workers = max(1, min(workers, items))
    if cpus is None:
        most = int(max((node.cpus for node in nodes), default=1))
        fitting = (
            count
            for count in range(most, 1, -1)
            if sum(_workers_that_fit(node, count, gpus) for node in nodes) >= workers
        )
        cpus = next(fitting, 1)
    return Placement(workers=workers, cpus=cpus, gpus=gpus)


def _workers_that_fit(node: Node, cpus: int, gpus: float) -> int:
    by_cpus = int(node.cpus // cpus)
    return min(by_cpus, int(node.gpus // gpus)) if gpus else by_cpus


def stop_actor(actor: Any, first: "ray.ObjectRef[Any]", *queued: "ray.ObjectRef[Any]") -> None:
    """Stop an actor. `first`: its first call, which shows whether it was created; `queued`: calls
    after it, to be cancelled.

    An actor that is just being created is not killed: if the kill overtakes the creation on its way
    to the worker, the raylet keeps the worker and its CPUs for ever (seen in Ray 2.60, once in some
    hundred kills at that moment; Ray's issues 13214 and 27743). It is asked to terminate instead,
    which waits behind the creation.
    """
    created, _ = ray.wait([first], timeout=0)
    if created:
        ray.kill(actor)
        return
    for call in (first, *queued):
        ray.cancel(call)
    actor.__ray_terminate__.remote()


def bounded_map(
    submit: Callable[[_Item], "ray.ObjectRef[Any]"], items: Iterable[_Item], window: int
) -> Iterator[tuple[_Item, Any]]:
    """Call `submit` on every item with at most `window` calls in flight; yield (item, result) as
    they finish.

    An exception in a call is raised here as it is, and nothing new is submitted after it.
    """
    pending = iter(items)
    running: dict[Any, _Item] = {submit(item): item for item in islice(pending, window)}
    while running:
        [done], _ = ray.wait(list(running), num_returns=1)
        item = running.pop(done)
        try:
            result = ray.get(done)
        except RayTaskError as error:
            raise error.cause or error from error
        for following in islice(pending, 1):
            running[submit(following)] = following
        yield item, result
