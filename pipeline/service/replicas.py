"""Answerers as Ray Serve's replicas, and the handle that asks them. One that dies is replaced; its
batch raises Gone.

HTTP does not pass through Serve: its proxy takes in a request's whole body before anyone can object
(docs/decisions.md).
"""

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import ray
from ray import serve
from ray.serve.exceptions import DeploymentUnavailableError

from pipeline.core import cluster
from pipeline.core.cluster import Placement
from pipeline.core.errors import InputError
from pipeline.service.batcher import ReplicaLost
from pipeline.service.engine import NotReady
from pipeline.service.live_index import RETRY_S
from pipeline.service.predictor import Outcome, Predictor, ServiceStatus
from pipeline.service.request import LocateRequest

BATCH_TIMEOUT_S = 120.0
"A batch that takes longer will not end: its replica is replaced."
MAX_ONGOING_REQUESTS = 16
"That a replica takes at once: its batch, and whoever asks for its status meanwhile."


class Replica:
    """One process with the network and the index. Batches are computed one after the other, by one
    thread.
    """

    def __init__(self, make: Callable[[], Predictor]) -> None:
        self._make = make
        self._thread = ThreadPoolExecutor(1)
        self._began: float | None = None
        self._answerer: Predictor | None = None
        self._unusable = ""
        self._load()
        threading.Thread(target=self._follow, daemon=True).start()

    def _load(self) -> None:
        try:
            self._answerer = self._make()
        # raised from the constructor it would come back from Serve as a page of traceback
        except InputError as error:
            self._unusable = str(error)

    def _follow(self) -> None:
        """Take over new indexes for ever; before, where network or index were unusable, try until
        they are mended.
        """
        while self._answerer is None:
            time.sleep(RETRY_S)
            self._load()
        self._answerer.live.follow(threading.Event())

    async def answer(self, questions: Sequence[LocateRequest]) -> list[Outcome]:
        return await asyncio.get_running_loop().run_in_executor(
            self._thread, self._answer, questions
        )

    def _answer(self, questions: Sequence[LocateRequest]) -> list[Outcome]:
        self._began = time.monotonic()
        try:
            return self._ready().answer(questions)
        finally:
            self._began = None

    async def status(self) -> ServiceStatus:
        return self._ready().status()

    def _ready(self) -> Predictor:
        if self._answerer is None:
            raise NotReady(self._unusable)
        return self._answerer

    def check_health(self) -> None:
        """Called by Serve every few seconds; a replica that raises here a few times is replaced."""
        began = self._began
        if began is not None and time.monotonic() > began + BATCH_TIMEOUT_S:
            raise TimeoutError(f"a batch has taken {BATCH_TIMEOUT_S:.0f} s")


class Replicas:
    """The replicas of one service, from the process that asks them."""

    def __init__(self, name: str, placement: Placement, make: Callable[[], Predictor]) -> None:
        """Nothing is started yet. `name` is no other application's on this cluster; `make` is
        called on each replica.
        """
        self._name, self._placement, self._make = name, placement, make
        self._handle: Any = None
        self._started = False

    def start(self) -> ServiceStatus:
        """Start all replicas and wait until they have loaded.

        Raises InputError when the network or the index cannot be used.
        """
        cluster.connect()
        logging.getLogger("ray.serve").setLevel(
            logging.ERROR
        )  # it warns at length of what is told here in a sentence
        deployment: serve.Deployment = serve.deployment(
            num_replicas=self._placement.workers,
            max_ongoing_requests=MAX_ONGOING_REQUESTS,
            ray_actor_options={"num_cpus": self._placement.cpus, "num_gpus": self._placement.gpus},
            # who asks while a replica is dead waits for so long besides the loading
            health_check_period_s=1,
            graceful_shutdown_wait_loop_s=0.2,
            graceful_shutdown_timeout_s=5,
        )(Replica)
        self._started = True
        serve.start(proxy_location="Disabled")
        handle = serve.run(deployment.bind(self._make), name=self._name, route_prefix=None)
        try:
            status: ServiceStatus = handle.status.remote().result(timeout_s=60)
        except NotReady as error:
            raise InputError(str(error)) from None
        self._handle = handle
        return status

    async def answer(self, questions: Sequence[LocateRequest]) -> list[Outcome]:
        """Raises NotReady, and Gone where the replica that was asked has died."""
        answered: list[Outcome] = await self._ask("answer", list(questions))
        return answered

    async def status(self) -> ServiceStatus:
        """Raises NotReady, and Gone likewise."""
        found: ServiceStatus = await self._ask("status")
        return found

    async def _ask(self, method: str, *arguments: Any) -> Any:
        if self._handle is None:
            raise NotReady("the network and the index are being loaded")
        try:
            return await getattr(self._handle, method).remote(*arguments)
        except ray.exceptions.RayActorError as error:
            raise ReplicaLost(str(error).split("\n")[0]) from None
        except DeploymentUnavailableError:
            raise NotReady("no replica can load the network and the index") from None

    def stop(self) -> None:
        """End this service's replicas, and Serve itself where nobody else's application is left."""
        if not self._started:
            return
        serve.delete(self._name)
        if not serve.status().applications:
            serve.shutdown()  # type: ignore[no-untyped-call]
