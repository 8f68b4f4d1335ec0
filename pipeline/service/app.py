"""The HTTP side of the service: routes, limits, and one sentence for each request that is refused.

In: requests. Out: responses. The engine that computes answers is passed in; nothing here knows Ray
or the encoder.
"""

import asyncio
import logging
import time
import traceback
from collections.abc import Awaitable, Callable

from aiohttp import web

from pipeline.core.progress import console
from pipeline.core.records import Rejection
from pipeline.service.access import AccessControl
from pipeline.service.batcher import Batcher, PoisonedItem, ReplicaLost
from pipeline.service.engine import Engine, NotReady
from pipeline.service.metrics import CONTENT_TYPE, ServiceMetrics
from pipeline.service.pages import SECURITY_HEADERS, page_routes
from pipeline.service.pictures import PictureRoutes
from pipeline.service.predictor import Outcome
from pipeline.service.request import (
    LocateRequest,
    RequestError,
    parse_request,
    undecodable_photo,
)
from pipeline.service.responses import answer_body, error_body, health_body
from pipeline.service.settings import ServiceSettings
from pipeline.service.uploads import check_headers, read_upload

KEEPALIVE_S = 30
"Seconds that a connection may be idle between two requests."

LINGER_S = 5
"""Seconds that the rest of a refused upload is read and dropped: a client whose connection is
closed while it sends reports a broken connection instead of the sentence."""

SHUTDOWN_GRACE_S = 5
"Seconds that requests in flight may take to end when the service is stopped."

HEALTH_TIMEOUT_S = 2
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Service:
    """The application with its queue, counters and access control."""

    def __init__(
        self,
        settings: ServiceSettings,
        engine: Engine,
        token: str | None = None,
        concurrency: int = 1,
    ) -> None:
        """`concurrency` is how many batches the engine computes at a time."""
        self._settings, self._engine = settings, engine
        self._access = AccessControl(token)
        self.metrics = ServiceMetrics(lambda: self._batcher.waiting)
        self._batcher: Batcher[LocateRequest, Outcome] = Batcher(
            engine.predict,
            max_batch=settings.batch,
            concurrency=concurrency,
            on_batch=self.metrics.batch,
        )
        self._capacity = settings.waiting + settings.batch * concurrency
        self._in_flight = 0
        self.app = web.Application(middlewares=[self._middleware])
        self.app.add_routes(page_routes(settings))
        self.app.add_routes(PictureRoutes(engine, settings.timeout_s).routes())
        self.app.router.add_get("/health", self._health)
        self.app.router.add_get("/metrics", self._metrics)
        self.app.router.add_post("/locate", self._locate, expect_handler=self._expect)

    def runner(self) -> web.AppRunner:
        """The runner that listens for this application."""
        # aiohttp's own logger prints a traceback for each malformed request, which would fill a
        # disk that keeps the output.
        quiet = logging.getLogger(f"{__name__}.malformed")
        quiet.setLevel(logging.CRITICAL)
        return web.AppRunner(
            self.app,
            access_log=None,
            logger=quiet,
            handler_cancellation=True,  # the photo of a client that disconnects leaves the queue
            keepalive_timeout=KEEPALIVE_S,
            lingering_time=LINGER_S,
            shutdown_timeout=SHUTDOWN_GRACE_S,
        )

    @web.middleware
    async def _middleware(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Checks access, turns errors into responses, and counts both."""
        began = time.monotonic()
        try:
            self._access.check(request)
            response = await handler(request)
        except RequestError as error:
            response = _error_response(error)
        except web.HTTPException as error:
            if error.status < 400:
                raise
            response = _router_error(request, error)
        except web.RequestPayloadError:
            response = _error_response(
                RequestError(400, "the body is damaged or incomplete; send the photo again")
            )
        except Exception:
            console.print(traceback.format_exc(), style="red")
            response = _error_response(
                RequestError(500, "the service failed and has logged the reason; send another one")
            )
        for name, value in SECURITY_HEADERS.items():
            response.headers.setdefault(name, value)
        path = "other" if request.match_info.route.resource is None else request.path
        self.metrics.request(path, response.status, time.monotonic() - began)
        return response

    async def _expect(self, request: web.Request) -> None:
        """Answer `Expect: 100-continue` before the client sends the body, unless the request will
        be refused."""
        try:
            self._access.check(request)
            self._check_before_body(request)
        except RequestError:
            return  # the handler raises it again
        if request.transport is not None:
            request.transport.write(b"HTTP/1.1 100 Continue\r\n\r\n")

    def _check_before_body(self, request: web.Request) -> None:
        """Raise RequestError for what can be refused before the body is read; this bounds the queue
        in photos and in bytes."""
        too_long = self._batcher.expected_queue_s > self._settings.timeout_s
        if self._in_flight >= self._capacity or too_long:
            raise RequestError(
                503,
                f"{self._in_flight} photos are before it; send this one again later",
                self._batcher.retry_after_estimate_s,
            )
        check_headers(request, self._settings.max_bytes)

    async def _locate(self, request: web.Request) -> web.Response:
        began = time.monotonic()
        self._check_before_body(request)
        limits = self._settings
        self._in_flight += 1
        try:
            photo, fields = await read_upload(request, limits.max_bytes, limits.upload_timeout_s)
            parsed = await asyncio.to_thread(parse_request, photo, fields, limits.max_pixels)
            outcome = await self._predict(parsed)
        finally:
            self._in_flight -= 1
        if isinstance(outcome, Rejection):
            raise undecodable_photo(outcome.reason, outcome.found)
        self.metrics.answer(outcome)
        if outcome.match_error is not None:
            console.print(
                f"a photo was not matched, its answer is a tile's: {outcome.match_error}",
                style="yellow",
                markup=False,
            )
        return web.json_response(answer_body(outcome, time.monotonic() - began))

    async def _predict(self, parsed: LocateRequest) -> Outcome:
        try:
            async with asyncio.timeout(self._settings.timeout_s):
                return await self._batcher.submit(parsed)
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
        trusted = self._access.is_trusted(request)
        try:
            async with asyncio.timeout(HEALTH_TIMEOUT_S):
                status = await self._engine.status()
        except (NotReady, ReplicaLost, TimeoutError) as error:
            body = health_body(None, str(error) or "no answer from the replicas", trusted)
            return web.json_response(body, status=503, headers={"Retry-After": "5"})
        return web.json_response(health_body(status, None, trusted))

    async def _metrics(self, request: web.Request) -> web.Response:
        return web.Response(body=self.metrics.text(), headers={"Content-Type": CONTENT_TYPE})


def _router_error(request: web.Request, error: web.HTTPException) -> web.Response:
    """The response to an unknown path or method."""
    expected = f"expected {error.headers['Allow']}" if "Allow" in error.headers else "see /api"
    sentence = f"{request.method} {request.path[:80]}: {error.reason.lower()}; {expected}"
    response = _error_response(RequestError(error.status, sentence))
    if "Allow" in error.headers:
        response.headers["Allow"] = error.headers["Allow"]
    return response


def _error_response(error: RequestError) -> web.Response:
    response = web.json_response(error_body(error.sentence), status=error.status)
    if error.status == 401:
        response.headers["WWW-Authenticate"] = "Bearer"
    if error.retry_after_s is not None:
        response.headers["Retry-After"] = str(error.retry_after_s)
    return response
