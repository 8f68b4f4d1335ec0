"""Predictors as Ray Serve replicas, and the handle that calls them. A replica that dies is
replaced; its batch raises ReplicaLost.

HTTP does not pass through Serve: its proxy reads a request's whole body before any check can refuse
it (docs/decisions.md).
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
from pipeline.service.photo_map import PictureRequest
from pipeline.service.predictor import Outcome, Predictor, ServiceStatus
from pipeline.service.request import LocateRequest

BATCH_TIMEOUT_S = 120.0
"Seconds after which a batch counts as stuck: its replica is replaced."

MAX_ONGOING_REQUESTS = 16
"Calls that a replica accepts at a time: its batch, and the status requests meanwhile."


class Replica:
    """One process with the encoder and the index. One thread computes batches one after another,
    another one the pictures of pages."""

    def __init__(self, make_predictor: Callable[[], Predictor]) -> None:
        self._make_predictor = make_predictor
        self._thread, self._pictures = ThreadPoolExecutor(1), ThreadPoolExecutor(1)
        self._batch_began: float | None = None
        self._predictor: Predictor | None = None
        self._load_error = ""
        self._load()
        threading.Thread(target=self._watch_index, daemon=True).start()

    def _load(self) -> None:
        try:
            self._predictor = self._make_predictor()
        except InputError as error:  # raised here, it would return from Serve as a long traceback
            self._load_error = str(error)

    def _watch_index(self) -> None:
        """Switch to new indexes forever; before that, while encoder or index cannot be used, retry
        until they are repaired."""
        while self._predictor is None:
            time.sleep(RETRY_S)
            self._load()
        self._predictor.live.watch(threading.Event())

    async def predict(self, requests: Sequence[LocateRequest]) -> list[Outcome]:
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._thread, self._predict, requests)

    def _predict(self, requests: Sequence[LocateRequest]) -> list[Outcome]:
        self._batch_began = time.monotonic()
        try:
            return self._loaded().predict(requests)
        finally:
            self._batch_began = None

    async def picture(self, wanted: PictureRequest) -> bytes | None:
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._pictures, self._loaded().picture, wanted)

    async def status(self) -> ServiceStatus:
        return self._loaded().status()

    def _loaded(self) -> Predictor:
        if self._predictor is None:
            raise NotReady(self._load_error)
        return self._predictor

    def check_health(self) -> None:
        """Serve calls this every second, and replaces a replica that raises a few times."""
        began = self._batch_began
        if began is not None and time.monotonic() > began + BATCH_TIMEOUT_S:
            raise TimeoutError(f"a batch has taken {BATCH_TIMEOUT_S:.0f} s")


class Replicas:
    """The replicas of one service, seen from the process that calls them; an Engine."""

    def __init__(
        self, name: str, placement: Placement, make_predictor: Callable[[], Predictor]
    ) -> None:
        """Starts nothing yet. `name` must be unique among the applications of this cluster;
        `make_predictor` is called on each replica."""
        self._name, self._placement, self._make_predictor = name, placement, make_predictor
        self._handle: Any = None
        self._started = False

    def start(self) -> ServiceStatus:
        """Start all replicas and wait until they have loaded.

        Raises InputError when the encoder or the index cannot be used.
        """
        cluster.connect()
        # Serve warns at length about load errors that this method raises as one sentence.
        logging.getLogger("ray.serve").setLevel(logging.ERROR)
        placement = self._placement
        deployment: serve.Deployment = serve.deployment(
            num_replicas=placement.workers,
            max_ongoing_requests=MAX_ONGOING_REQUESTS,
            ray_actor_options={"num_cpus": placement.cpus, "num_gpus": placement.gpus},
            health_check_period_s=1,  # a dead replica's callers wait this long, and for the loading
            graceful_shutdown_wait_loop_s=0.2,
            graceful_shutdown_timeout_s=5,
        )(Replica)
        self._started = True
        serve.start(proxy_location="Disabled")
        application = deployment.bind(self._make_predictor)
        handle = serve.run(application, name=self._name, route_prefix=None)
        try:
            status: ServiceStatus = handle.status.remote().result(timeout_s=60)
        except NotReady as error:
            # Ray's own kind has the replica's traceback in its text; the sentence is its cause.
            raise InputError(str(getattr(error, "cause", error))) from None
        self._handle = handle
        return status

    async def predict(self, requests: Sequence[LocateRequest]) -> list[Outcome]:
        """Raises NotReady, and ReplicaLost where the replica has died."""
        outcomes: list[Outcome] = await self._call("predict", list(requests))
        return outcomes

    async def picture(self, wanted: PictureRequest) -> bytes | None:
        """Raises NotReady, and ReplicaLost where the replica has died."""
        found: bytes | None = await self._call("picture", wanted)
        return found

    async def status(self) -> ServiceStatus:
        """Raises NotReady, and ReplicaLost where the replica has died."""
        status: ServiceStatus = await self._call("status")
        return status

    async def _call(self, method: str, *arguments: Any) -> Any:
        if self._handle is None:
            raise NotReady("the encoder and the index are being loaded")
        try:
            return await getattr(self._handle, method).remote(*arguments)
        except ray.exceptions.RayActorError as error:
            raise ReplicaLost(str(error).split("\n")[0]) from None
        except DeploymentUnavailableError:
            raise NotReady("no replica can load the encoder and the index") from None

    def stop(self) -> None:
        """End this service's replicas, and Serve itself where no other application is left."""
        if not self._started:
            return
        serve.delete(self._name)
        if not serve.status().applications:
            serve.shutdown()  # type: ignore[no-untyped-call]
