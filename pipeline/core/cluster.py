"""Ray as this project uses it: one way to connect, and one way to spread calls with a bounded
number in flight.
"""

import logging
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from types import FrameType
from typing import Any, TypeVar

import ray
from ray._private.utils import read_ray_address
from ray.exceptions import RayTaskError

from pipeline.core.errors import Incomplete
from pipeline.core.progress import console

Item = TypeVar("Item")


CORES_PER_WORKER = 8
"Of a worker without a GPU, where nothing was said: a network's threads gain little beyond."


@dataclass(frozen=True, kw_only=True)
class Node:
    """One machine of a cluster."""

    cpus: float
    gpus: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Placement:
    """What is asked of Ray."""

    workers: int
    cpus: int
    "Of each worker."
    gpus: float
    "Of each worker."

    def __str__(self) -> str:
        return f"{self.cpus} CPUs and {self.gpus:g} GPUs" if self.gpus else f"{self.cpus} CPUs"


def connect() -> None:
    """Join the cluster that RAY_ADDRESS names (`ray job submit` sets it) or that `ray start` began
    on this machine, else start one for this process. Idempotent.

    Workers' output stays in Ray's session folder: what a worker has to say comes back as a result
    or an exception. Raises Unfinished where no cluster answers and none can be started.
    """
    if ray.is_initialized():
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault(
        "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0"
    )  # Ray's coming default; unset, each init warns
    # A token for a local cluster is what we want, and no news.
    logging.getLogger("ray._private.authentication.authentication_token_setup").setLevel(
        logging.ERROR
    )
    try:
        with _keep_signal_handlers():
            ray.init(_address(), log_to_driver=False, logging_level=logging.WARNING)
    except (
        Exception
    ) as error:  # Ray raises ConnectionError, RuntimeError, ValueError and plain Exception here
        asked = f"at {address}" if (address := os.environ.get("RAY_ADDRESS")) else "on this machine"
        why = str(error).strip().partition("\n")[0] or type(error).__name__
        raise Incomplete(
            f"found no Ray cluster {asked}, and none could be started ({why}); expected one "
            "that answers; see to it, or unset RAY_ADDRESS so that one is started here, and run the same command again"
        ) from error


def _address() -> str | None:
    """What to tell Ray: None, so that it looks for itself; "local" where it would find a cluster
    that is no more.

    `ray start` notes its address in a file, which outlives a cluster that was killed, and Ray waits for that one for ever.
    """
    noted = None if os.environ.get("RAY_ADDRESS") else read_ray_address()
    if not noted:
        return None
    host, _, port = noted.rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=5).close()
    except (OSError, ValueError):  # the latter: no address
        console.print(
            f"the Ray cluster at {noted} that `ray start` began is gone; one is started for this run"
        )
        return "local"
    return None


@contextmanager
def _keep_signal_handlers() -> Iterator[None]:
    """Keep Ctrl-C until Ray has started, as half of it cannot be stopped: it crashes. Said twice it
    is heeded at once.

    And keep the handler of SIGTERM: Ray's own would end this process by an abort, with a stack of
    its C++ on the terminal, or while it starts by a bare exit.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []

    def keep(number: int, frame: FrameType | None) -> None:
        came.append(number)
        if len(came) > 1:
            raise KeyboardInterrupt

    interrupt = signal.signal(signal.SIGINT, keep)
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
    if came and callable(interrupt):
        interrupt(signal.SIGINT, None)


def cpus() -> int:
    """CPU cores of the whole cluster, at least 1."""
    return max(1, int(_resources().get("CPU", 1)))


def gpus() -> int:
    """GPUs of the whole cluster."""
    return int(_resources().get("GPU", 0))


def nodes() -> list[Node]:
    """The machines of the cluster that are up."""
    up = [node["Resources"] for node in ray.nodes() if node["Alive"]]  # type: ignore[no-untyped-call]
    return [Node(cpus=has.get("CPU", 0.0), gpus=has.get("GPU", 0.0)) for has in up]


def _resources() -> dict[str, float]:
    found: dict[str, float] = ray.cluster_resources()  # type: ignore[no-untyped-call]
    return found


def stop_actor(actor: Any, first: "ray.ObjectRef[Any]", *queued: "ray.ObjectRef[Any]") -> None:
    """End an actor. `first`: its first call, which shows whether it was created; `queued`: calls
    behind that, given up.

    An actor that is just being created is not killed: where the kill overtakes the creation on its
    way to the worker, the raylet keeps the worker and its CPUs for ever (seen in Ray 2.60, once in
    some hundred kills at that moment; Ray's issues 13214 and 27743). It is asked to end instead,
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
    submit: Callable[[Item], "ray.ObjectRef[Any]"], items: Iterable[Item], window: int
) -> Iterator[tuple[Item, Any]]:
    """Call `submit` on every item with at most `window` calls in flight; yield (item, result) as
    they finish.

    An exception in a call is raised here as it is, after nothing new has been submitted.
    """
    waiting = iter(items)
    running: dict[Any, Item] = {submit(item): item for item in islice(waiting, window)}
    while running:
        [done], _ = ray.wait(list(running), num_returns=1)
        item = running.pop(done)
        try:
            result = ray.get(done)
        except RayTaskError as error:
            raise error.cause or error from error
        for following in islice(waiting, 1):
            running[submit(following)] = following
        yield item, result


def plan_placement(
    nodes: Sequence[Node],
    items: int,
    workers: int | None = None,
    cpus: int | None = None,
    gpus: float | None = None,
) -> Placement:
    """A placement for so many items. None: one worker per GPU where there are any, else one per
    eight cores of a node; and as many cores each as let all of them fit on the nodes that are
    there, at least 1."""
    if gpus is None:
        gpus = 1.0 if any(node.gpus >= 1 for node in nodes) else 0.0
    if workers is None:
        workers = sum(
            _workers_that_fit(
                node, cpus or (1 if gpus else min(CORES_PER_WORKER, max(1, int(node.cpus)))), gpus
            )
            for node in nodes
        )
    workers = max(1, min(workers, items))
    if cpus is None:
        most = int(max((node.cpus for node in nodes), default=1))
        fitting = (
            c
            for c in range(most, 1, -1)
            if sum(_workers_that_fit(node, c, gpus) for node in nodes) >= workers
        )
        cpus = next(fitting, 1)
    return Placement(workers=workers, cpus=cpus, gpus=gpus)


def _workers_that_fit(node: Node, cpus: int, gpus: float) -> int:
    """How many such workers a node holds."""
    by_cpus = int(node.cpus // cpus)
    return min(by_cpus, int(node.gpus // gpus)) if gpus else by_cpus
