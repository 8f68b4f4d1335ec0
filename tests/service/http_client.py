"""The service on a socket of this process, with an engine that computes nothing, and requests."""

import asyncio
import io
import json
from collections.abc import Callable, Coroutine, Sequence
from typing import Any

import aiohttp
from aiohttp import web
from aiohttp.test_utils import BaseTestServer, TestClient
from PIL import Image

from pipeline.core.records import Rejection, View
from pipeline.index.searcher import Hit
from pipeline.locate.locate import NO_ANSWER, Answer, Position
from pipeline.service.app import Service
from pipeline.service.batcher import ReplicaLost
from pipeline.service.engine import NotReady
from pipeline.service.photo_map import Located, PictureRequest, TilePicture
from pipeline.service.predictor import Outcome, ServiceStatus
from pipeline.service.request import LocateRequest
from pipeline.service.settings import ServiceSettings
from tests.service.photos import photo

TOKEN = "a-token-of-some-length"
Client = TestClient[Any, Any]
HEAD = (
    b"POST /locate HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nContent-Type: image/jpeg\r\n"
)


def fake_answer(request: LocateRequest) -> Answer:
    """A made-up answer with as many candidates as requested."""
    hits = tuple(
        Hit(
            key=f"gallery-{n}",
            location=f"{n:04d}",
            view=View.SATELLITE,
            lat=47.0 + n / 1000,
            lon=8.0,
            score=0.9 - n / 100,
        )
        for n in range(request.top)
    )
    return Answer(
        position=Position(lat=47.0, lon=8.0, radius_m=25.0),
        location="0000",
        probability=0.8,
        known=True,
        candidates=hits,
        agreeing=1,
    )


class FakeEngine:
    """Answers at once, or when `gate` opens. A photo of 13 pixels' width kills the replica, one of
    14 cannot be decoded, and for one of 15 the search finds nothing."""

    def __init__(self, outcome: Located | None = None) -> None:
        self.outcome = outcome
        self.batches: list[Sequence[LocateRequest]] = []
        self.pictures: list[PictureRequest] = []
        self.gate = asyncio.Event()
        self.gate.set()
        self.ready = True

    async def predict(self, requests: Sequence[LocateRequest]) -> Sequence[Outcome]:
        if not self.ready:
            raise NotReady("the encoder is being loaded")
        self.batches.append(requests)
        await self.gate.wait()
        return [self._outcome(request) for request in requests]

    def _outcome(self, request: LocateRequest) -> Outcome:
        with Image.open(io.BytesIO(request.photo)) as opened:
            if opened.width == 13:
                raise ReplicaLost("the replica has died")
            if opened.width == 14:
                return Rejection(path="photo 1", reason="damaged image", found="99 bytes")
            if opened.width == 15:
                return Located(answer=NO_ANSWER)
        return self.outcome or Located(answer=fake_answer(request))

    async def picture(self, wanted: PictureRequest) -> bytes | None:
        """That of the candidate `gallery-0`, and no other."""
        if not self.ready:
            raise NotReady("the encoder is being loaded")
        self.pictures.append(wanted)
        await self.gate.wait()
        return photo("WEBP") if wanted == TilePicture(key="gallery-0") else None

    async def status(self) -> ServiceStatus:
        if not self.ready:
            raise NotReady("the encoder is being loaded")
        return ServiceStatus(
            fingerprint="f" * 64,
            rows=3,
            factory="Flat",
            calibrated=True,
            matched=False,
            refused=None,
        )


class Server(BaseTestServer):
    """The service on a socket, with the runner that the job uses."""

    def __init__(self, service: Service) -> None:
        super().__init__()
        self.service = service

    async def _make_runner(self, **_: Any) -> web.AppRunner:
        return self.service.runner()


def run_with_service(
    test: Callable[[Client, FakeEngine], Coroutine[Any, Any, None]],
    token: str | None = None,
    outcome: Located | None = None,
    **settings: Any,
) -> None:
    """Run a test against a service of its own on a socket."""

    async def main() -> None:
        engine = FakeEngine(outcome)
        service = Service(ServiceSettings(**settings), engine, token)
        client: Client = TestClient(Server(service))
        async with client:
            await test(client, engine)

    asyncio.run(asyncio.wait_for(main(), 30))


async def error_sentence(response: aiohttp.ClientResponse, status: int) -> str:
    """The sentence of an error response with this status."""
    text = await response.text()
    assert response.status == status, text
    body = json.loads(text)
    assert set(body) == {"error"}
    assert "\n" not in body["error"]
    return str(body["error"])


def post(
    client: Client, data: Any, kind: str = "image/jpeg", query: str = "", **headers: str
) -> Any:
    return client.post(f"/locate{query}", data=data, headers={"Content-Type": kind} | headers)


def form(**fields: Any) -> aiohttp.FormData:
    data = aiohttp.FormData(default_to_multipart=True)
    for name, value in fields.items():
        data.add_field(name, value, filename=None if isinstance(value, str) else "a.jpg")
    return data


async def send_raw(client: Client, *pieces: bytes) -> bytes:
    """The response to these bytes, until the service closes the connection."""
    reader, writer = await asyncio.open_connection(client.host, client.port)
    for piece in pieces:
        writer.write(piece)
        await writer.drain()
    response = await reader.read()
    writer.close()
    return response
