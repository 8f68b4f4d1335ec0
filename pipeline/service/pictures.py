"""The routes of the gallery's pixels, for the page: small images of candidates, and the map around
an answer.

In: requests with the key of an image, or a square of ground. Out: WebP, kept for some minutes here
and in the browser. Access is checked before, as for answers.
"""

import asyncio
import math
import re
import time
from collections import OrderedDict

from aiohttp import web

from pipeline.service.batcher import ReplicaLost
from pipeline.service.engine import Engine, NotReady
from pipeline.service.photo_map import GroundPicture, PictureRequest, TilePicture
from pipeline.service.request import RequestError

KEY = re.compile(r"[a-z0-9_-]{1,200}")
MAX_HALF_M = 20_000.0
KEPT_S, KEPT_BYTES = 600, 32_000_000
"How long pictures are kept, and how much of them: an index that is replaced shows other ground."
AT_ONCE, MAX_WAITING = 2, 64
"Calls of replicas, which answer photos beside, and requests that may wait for them."


class PictureRoutes:
    """Answers GET /tile and GET /map."""

    def __init__(self, engine: Engine, timeout_s: float) -> None:
        self._engine, self._timeout_s = engine, timeout_s
        self._kept: OrderedDict[PictureRequest, tuple[float, bytes]] = OrderedDict()
        self._kept_bytes = self._waiting = 0
        self._turn = asyncio.Semaphore(AT_ONCE)

    def routes(self) -> list[web.RouteDef]:
        return [web.get("/tile", self._tile), web.get("/map", self._map)]

    async def _tile(self, request: web.Request) -> web.Response:
        key = request.query.get("key", "")
        if not KEY.fullmatch(key):
            raise RequestError(400, f"key is {key[:40]!r}, expected the key of a candidate")
        return await self._respond(TilePicture(key=key))

    async def _map(self, request: web.Request) -> web.Response:
        return await self._respond(
            GroundPicture(
                lat=_number(request, "lat", -85, 85),
                lon=_number(request, "lon", -180, 180),
                half_m=_number(request, "half_m", 1, MAX_HALF_M),
            )
        )

    async def _respond(self, wanted: PictureRequest) -> web.Response:
        data = self._find(wanted)
        if data is None:
            data = await self._ask(wanted)
            if data is None:
                raise RequestError(
                    404,
                    "the service has no pixels of that, expected an image of its gallery or "
                    "ground that these show; start it with --shards",
                )
            self._keep(wanted, data)
        headers = {"Cache-Control": f"private, max-age={KEPT_S}", "Vary": "Authorization"}
        return web.Response(body=data, content_type="image/webp", headers=headers)

    async def _ask(self, wanted: PictureRequest) -> bytes | None:
        if self._waiting >= MAX_WAITING:
            raise RequestError(503, f"{self._waiting} pictures are before it; ask again later", 1)
        self._waiting += 1
        try:
            async with asyncio.timeout(self._timeout_s), self._turn:
                return await self._engine.picture(wanted)
        except TimeoutError:
            raise RequestError(504, "the picture was not made in time; ask again") from None
        except (NotReady, ReplicaLost) as error:
            raise RequestError(503, f"not ready: {error}; ask again later", 5) from None
        finally:
            self._waiting -= 1

    def _find(self, wanted: PictureRequest) -> bytes | None:
        expires, data = self._kept.get(wanted, (0.0, b""))
        return data if time.monotonic() < expires else None

    def _keep(self, wanted: PictureRequest, data: bytes) -> None:
        _, before = self._kept.pop(wanted, (0.0, b""))
        self._kept[wanted] = time.monotonic() + KEPT_S, data
        self._kept_bytes += len(data) - len(before)
        while self._kept_bytes > KEPT_BYTES:
            _, (_, dropped) = self._kept.popitem(last=False)
            self._kept_bytes -= len(dropped)


def _number(request: web.Request, name: str, least: float, most: float) -> float:
    text = request.query.get(name, "")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        raise RequestError(
            400, f"{name} is {text[:40]!r}, expected a number from {least:g} to {most:g}"
        )
    return value
