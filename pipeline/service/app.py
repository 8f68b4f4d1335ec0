"""The service as HTTP: routes, limits, one sentence for whatever is not answered. Who computes is
handed in.

Nothing here knows Ray or the network; `engine` may be anything that answers batches of questions.
"""

import asyncio
import dataclasses
import hmac
import logging
import time
import traceback
from collections.abc import Awaitable, Callable

from aiohttp import web

from pipeline.core.progress import console
from pipeline.core.records import Rejection
from pipeline.service.batcher import Batcher, PoisonedItem, ReplicaLost
from pipeline.service.engine import Engine, NotReady
from pipeline.service.metrics import CONTENT_TYPE, ServiceMetrics
from pipeline.service.pages import PAGE_PATHS, SECURITY_HEADERS, page_routes
from pipeline.service.predictor import Outcome
from pipeline.service.request import LocateRequest, RequestError, parse_request, undecodable_photo
from pipeline.service.settings import LOOPBACK_HOSTS, ServiceSettings
from pipeline.service.uploads import check_headers, read_upload

PUBLIC_PATHS = {*PAGE_PATHS, "/health"}
"""Paths that need no token: the pages, which say nothing of the index, and what a load balancer
asks."""
KEEPALIVE_S = 30
"Seconds that a connection may be idle between two requests."
LINGER_S = 5
"""Seconds that the rest of a refused upload is read and dropped: a client cut off while it sends
sees a broken connection in place of the sentence."""
SHUTDOWN_GRACE_S = 5
"Seconds that requests in flight have to end when the service is told to stop."
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Service:
    """The application and what it keeps: the queue, the counters, the token."""

    def __init__(
        self,
        settings: ServiceSettings,
        engine: Engine,
        token: str | None = None,
        concurrency: int = 1,
    ) -> None:
        """`concurrency` is how many batches the engine computes at a time."""
        self._settings, self._engine, self._token = settings, engine, token
        self.metrics = ServiceMetrics(lambda: self._batcher.waiting)
        self._batcher: Batcher[LocateRequest, Outcome] = Batcher(
            engine.answer,
            largest=settings.batch,
            concurrency=concurrency,
            on_batch=self.metrics.batch,
        )
        self._places = settings.waiting + settings.batch * concurrency
        self._taken = 0
        self.app = web.Application(middlewares=[self._outermost])
        self.app.add_routes([
            *page_routes(settings), web.get("/health", self._health), web.get("/metrics", self._metrics)
        ])  # fmt: skip
        self.app.router.add_post("/locate", self._locate, expect_handler=self._expect)

    def runner(self) -> web.AppRunner:
        """What listens for this application."""
        # aiohttp's own would print a traceback over each malformed request, and fill the disk of
        # whoever keeps them.
        quiet = logging.getLogger(f"{__name__}.malformed")
        quiet.setLevel(logging.CRITICAL)
        return web.AppRunner(
            self.app,
            access_log=None,
            logger=quiet,
            handler_cancellation=True,  # whoever has gone away leaves the queue
            keepalive_timeout=KEEPALIVE_S,
            lingering_time=LINGER_S,
            shutdown_timeout=SHUTDOWN_GRACE_S,
        )

    @web.middleware
    async def _outermost(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Who may ask, what becomes of errors, and the counting of both."""
        began = time.monotonic()
        try:
            self._admit(request)
            response = await handler(request)
        except RequestError as refusal:
            response = _error_response(refusal)
        except web.HTTPException as error:
            if error.status < 400:
                raise
            allowed = (
                f"; expected {error.headers['Allow']}" if "Allow" in error.headers else "; see /api"
            )
            sentence = f"{request.method} {request.path[:80]}: {error.reason.lower()}{allowed}"
            response = _error_response(RequestError(error.status, sentence))
            response.headers.extend(
                {name: error.headers[name] for name in ("Allow",) if name in error.headers}
            )
        except web.RequestPayloadError:
            response = _error_response(
                RequestError(
                    400, "the body ends or breaks off before its end; send the photo again"
                )
            )
        except Exception:
            console.print(traceback.format_exc(), style="red")
            response = _error_response(
                RequestError(
                    500, "the service failed over this request; it has noted why; send another"
                )
            )
        for name, value in SECURITY_HEADERS.items():
            response.headers.setdefault(name, value)
        path = "other" if request.match_info.route.resource is None else request.path
        self.metrics.request(path, response.status, time.monotonic() - began)
        return response

    def _admit(self, request: web.BaseRequest) -> None:
        """Raise Refusal where this request is nobody's business, whatever it asks."""
        # A page whose name was made to lead to this machine is not another site's in its browser's
        # eyes.
        host = request.host.rsplit(":", 1)[0].strip("[]")
        if self._token is None and host not in LOOPBACK_HOSTS:
            raise RequestError(
                403,
                f"the host is {host[:60]!r}, expected localhost; ask by that name, or start it with --token-file",
            )
        if (
            request.headers.get("Sec-Fetch-Site") == "cross-site"
            and request.path not in PUBLIC_PATHS
        ):
            raise RequestError(
                403, "another site's page asks, expected the service's own; open the service itself"
            )
        if request.path not in PUBLIC_PATHS and not self._trusted(request):
            found = "another token" if "Authorization" in request.headers else "no token"
            raise RequestError(
                401,
                f"found {found}, expected the header Authorization: Bearer with the service's token",
            )

    def _trusted(self, request: web.BaseRequest) -> bool:
        """Whether a request brings the token, where there is one; compared in a time that tells
        nothing of it.
        """
        given = request.headers.get("Authorization", "").encode("utf-8", "surrogateescape")
        return self._token is None or hmac.compare_digest(given, f"Bearer {self._token}".encode())

    async def _expect(self, request: web.Request) -> None:
        """A client that asks before it sends (`Expect: 100-continue`) is told to; one that will be
        refused is not.
        """
        try:
            self._admit(request)
            self._refuse_early(request)
        except RequestError:
            return  # the handler says why
        if request.transport is not None:
            request.transport.write(b"HTTP/1.1 100 Continue\r\n\r\n")

    def _refuse_early(self, request: web.Request) -> None:
        """Raise Refusal for what can be refused before the body is read; so what waits is bounded
        in number and in bytes.
        """
        if self._taken >= self._places or self._batcher.expected_queue_s > self._settings.timeout_s:
            raise RequestError(
                503,
                f"{self._taken} photos are before it; send this one again later",
                self._batcher.retry_after_estimate_s,
            )
        check_headers(request, self._settings.max_bytes)

    async def _locate(self, request: web.Request) -> web.Response:
        began = time.monotonic()
        self._refuse_early(request)
        self._taken += 1
        try:
            settings = self._settings
            photo, fields = await read_upload(
                request, settings.max_bytes, settings.upload_timeout_s
            )
            question = await asyncio.to_thread(parse_request, photo, fields, settings.max_pixels)
            outcome = await self._ask(question)
        finally:
            self._taken -= 1
        if isinstance(outcome, Rejection):
            raise undecodable_photo(outcome.reason, outcome.found)
        seconds = round(time.monotonic() - began, 4)
        return web.json_response(dataclasses.asdict(outcome) | {"seconds": seconds})

    async def _ask(self, question: LocateRequest) -> Outcome:
        try:
            async with asyncio.timeout(self._settings.timeout_s):
                return await self._batcher.ask(question)
        except TimeoutError:
            raise RequestError(
                504,
                f"there was no answer within {self._settings.timeout_s:g} s; send the photo again",
            ) from None
        except NotReady as error:
            raise RequestError(503, f"not ready: {error}; send the photo again later", 5) from None
        except PoisonedItem:
            raise RequestError(
                422,
                "computing stopped twice over this photo; save it as a plain JPEG and send that",
            ) from None

    async def _health(self, request: web.Request) -> web.Response:
        try:
            async with asyncio.timeout(2):
                status = await self._engine.status()
        except (NotReady, ReplicaLost, TimeoutError) as error:
            why = str(error) or "no answer from the replicas"
            body = {"ready": False} | ({"why": why} if self._trusted(request) else {})
            return web.json_response(body, status=503, headers={"Retry-After": "5"})
        details = (
            dataclasses.asdict(status) if self._trusted(request) else {}
        )  # they name paths of this machine
        return web.json_response({"ready": True} | details)

    async def _metrics(self, request: web.Request) -> web.Response:
        return web.Response(body=self.metrics.text(), headers={"Content-Type": CONTENT_TYPE})


def _error_response(refusal: RequestError) -> web.Response:
    response = web.json_response({"error": refusal.sentence}, status=refusal.status)
    if refusal.status == 401:
        response.headers["WWW-Authenticate"] = "Bearer"
    if refusal.retry_after_s is not None:
        response.headers["Retry-After"] = str(refusal.retry_after_s)
    return response
