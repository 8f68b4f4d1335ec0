"""The service over HTTP against an engine in this process: answers, refusals, limits, and uploads
that mean harm.
"""

import asyncio
import io
import json
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from aiohttp import web
from aiohttp.test_utils import BaseTestServer, TestClient
from PIL import Image

from pipeline.core.errors import InputError
from pipeline.core.geo import Circle
from pipeline.core.records import Rejection, View
from pipeline.index.searcher import Hit
from pipeline.locate.locate import Answer, Position
from pipeline.service.app import Service
from pipeline.service.batcher import ReplicaLost
from pipeline.service.engine import NotReady
from pipeline.service.predictor import Outcome, ServiceStatus
from pipeline.service.request import LocateRequest
from pipeline.service.settings import ServiceSettings
from tests.service.test_request import bomb, photo

TOKEN = "a-token-of-some-length"
Client = TestClient[Any, Any]


def answer_of(question: LocateRequest) -> Answer:
    """Made up, as many candidates as were asked for."""
    hits = tuple(
        Hit(
            key=f"gallery-{n}",
            location=f"{n:04d}",
            view=View.SATELLITE,
            lat=47.0 + n / 1000,
            lon=8.0,
            score=0.9 - n / 100,
        )
        for n in range(question.top)
    )
    return Answer(
        position=Position(lat=47.0, lon=8.0, radius_m=25.0),
        location="0000",
        probability=0.8,
        known=True,
        candidates=hits,
        agreeing=1,
    )


class Engine:
    """Answers at once, or when `gate` opens; a photo of 13 pixels' width kills it, one of 14 turns
    out to be damaged.
    """

    def __init__(self) -> None:
        self.asked: list[Sequence[LocateRequest]] = []
        self.gate = asyncio.Event()
        self.gate.set()
        self.ready = True

    async def answer(self, questions: Sequence[LocateRequest]) -> Sequence[Outcome]:
        if not self.ready:
            raise NotReady("the network is being loaded")
        self.asked.append(questions)
        await self.gate.wait()
        return [self._one(question) for question in questions]

    def _one(self, question: LocateRequest) -> Outcome:
        with Image.open(io.BytesIO(question.photo)) as opened:
            if opened.width == 13:
                raise ReplicaLost("the worker has died")
            if opened.width == 14:
                return Rejection(path="photo 1", reason="damaged image", found="99 bytes")
        return answer_of(question)

    async def status(self) -> ServiceStatus:
        if not self.ready:
            raise NotReady("the network is being loaded")
        return ServiceStatus(
            fingerprint="f" * 64, rows=3, factory="Flat", calibrated=True, refused=None
        )


class Server(BaseTestServer):
    """The service on a socket, listening as the job lets it listen."""

    def __init__(self, service: Service) -> None:
        super().__init__()
        self.service = service

    async def _make_runner(self, **_: Any) -> web.AppRunner:
        return self.service.runner()


def served(
    test: Callable[[Client, Engine], Coroutine[Any, Any, None]],
    token: str | None = None,
    **settings: Any,
) -> None:
    """Run a test against a service of its own on a socket."""

    async def main() -> None:
        engine = Engine()
        service = Service(ServiceSettings(**settings), engine, token)
        client: Client = TestClient(Server(service))
        async with client:
            await test(client, engine)

    asyncio.run(asyncio.wait_for(main(), 30))


async def said(response: aiohttp.ClientResponse, status: int) -> str:
    """The one sentence of a refusal with this status."""
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
    made = aiohttp.FormData(default_to_multipart=True)
    for name, value in fields.items():
        made.add_field(name, value, filename=None if isinstance(value, str) else "a.jpg")
    return made


def test_a_photo_as_the_body_is_answered_with_position_confidence_and_candidates() -> None:
    async def test(client: Client, engine: Engine) -> None:
        response = await post(client, photo(), query="?top=2&lat=47&lon=8&radius_m=500")
        assert response.status == 200
        body = await response.json()
        assert body["position"] == {"lat": 47.0, "lon": 8.0, "radius_m": 25.0}
        assert (body["probability"], body["known"], body["location"]) == (0.8, True, "0000")
        assert [hit["key"] for hit in body["candidates"]] == ["gallery-0", "gallery-1"]
        assert body["seconds"] >= 0
        [[question]] = engine.asked
        assert question == LocateRequest(
            photo=photo(), near=Circle(lat=47, lon=8, radius_m=500), top=2
        )

    served(test)


def test_a_form_is_answered_alike_and_its_fields_stand_before_the_querys() -> None:
    async def test(client: Client, engine: Engine) -> None:
        data = form(
            lat="47", lon="8", radius_m="500", top="3", photo=photo("PNG"), of_no_interest="1"
        )
        response = await client.post("/locate?top=9", data=data)
        assert response.status == 200, await response.text()
        [[question]] = engine.asked
        assert question == LocateRequest(
            photo=photo("PNG"), near=Circle(lat=47, lon=8, radius_m=500), top=3
        )

    served(test)


HOSTILE: list[tuple[str, int, str, Callable[[Client], Awaitable[Any]]]] = [
    ("nothing", 400, "empty", lambda c: post(c, b"")),
    ("an empty form field", 400, "empty", lambda c: c.post("/locate", data=form(photo=b""))),
    ("50 MB", 413, "larger than 1 MB", lambda c: post(c, io.BytesIO(bytes(50_000_000)))),
    (
        "50 MB in a form",
        413,
        "larger than 1 MB",
        lambda c: c.post("/locate", data=form(photo=io.BytesIO(bytes(50_000_000)))),
    ),
    ("a bomb", 413, "5000 x 5000", lambda c: post(c, bomb(5000), "image/png")),
    (
        "an SVG",
        415,
        "expected a JPEG",
        lambda c: post(c, b"<svg xmlns='http://www.w3.org/2000/svg'/>", "image/svg+xml"),
    ),
    ("a truncated JPEG", 422, "truncated", lambda c: post(c, photo()[:-9])),
    ("another method", 405, "expected POST", lambda c: c.get("/locate")),
    ("another path", 404, "not found", lambda c: c.post("/locat", data=photo())),
    ("another content type", 415, "text/plain", lambda c: post(c, photo(), "text/plain")),
    (
        "curl's own content type",
        415,
        "form-urlencoded",
        lambda c: post(c, photo(), "application/x-www-form-urlencoded"),
    ),
    (
        "a compressed body",
        415,
        "compressed",
        lambda c: post(c, b"\x1f\x8b", **{"Content-Encoding": "gzip"}),
    ),
    (
        "a latitude that is none",
        400,
        "lat is 'NaN'",
        lambda c: post(c, photo(), query="?lat=NaN&lon=1&radius_m=2"),
    ),
    (
        "a form without a photo",
        400,
        "no field photo",
        lambda c: c.post("/locate", data=form(file="no photo")),
    ),
    (
        "a form without an end",
        400,
        "form",
        lambda c: post(c, b"--x\r\nContent-Disp", "multipart/form-data; boundary=x"),
    ),
    ("a form without a boundary", 400, "form", lambda c: post(c, b"--x", "multipart/form-data")),
    (
        "a form within a form",
        400,
        "another form",
        lambda c: post(
            c,
            b"--x\r\nContent-Type: multipart/mixed; boundary=y\r\n\r\n--y--\r\n--x--\r\n",
            "multipart/form-data; boundary=x",
        ),
    ),
    (
        "a field that is long",
        400,
        "longer than",
        lambda c: c.post("/locate", data=form(lat="1" * 999, photo=photo())),
    ),
    (
        "many fields",
        400,
        "fields",
        lambda c: c.post("/locate", data=form(**{f"f{n}": "1" for n in range(99)})),
    ),
    ("a photo that kills twice", 422, "stopped twice", lambda c: post(c, photo(size=(13, 13)))),
    ("a photo damaged within", 422, "damaged", lambda c: post(c, photo(size=(14, 14)))),
    (
        "a name made to lead here",
        403,
        "expected localhost",
        lambda c: post(c, photo(), Host="evil.example:80"),
    ),
    (
        "another site's page",
        403,
        "another site",
        lambda c: post(c, photo(), **{"Sec-Fetch-Site": "cross-site"}),
    ),
]


@pytest.mark.parametrize(
    ("status", "word", "harm"), [row[1:] for row in HOSTILE], ids=[row[0] for row in HOSTILE]
)
def test_what_means_harm_gets_a_sentence_and_the_next_request_its_answer(
    status: int, word: str, harm: Callable[[Client], Awaitable[Any]]
) -> None:
    async def test(client: Client, engine: Engine) -> None:
        assert word in await said(await harm(client), status)
        assert (await post(client, photo())).status == 200

    served(test, max_megabytes=1, max_megapixels=1)


async def raw(client: Client, *pieces: bytes) -> bytes:
    """What comes back for these bytes, until the service closes the connection."""
    reader, writer = await asyncio.open_connection(client.host, client.port)
    for piece in pieces:
        writer.write(piece)
        await writer.drain()
    answered = await reader.read()
    writer.close()
    return answered


HEAD = (
    b"POST /locate HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nContent-Type: image/jpeg\r\n"
)


def test_an_upload_without_a_length_is_cut_off_at_the_limit() -> None:
    async def test(client: Client, engine: Engine) -> None:
        piece = b"10000\r\n" + bytes(65_536) + b"\r\n"
        answered = await raw(
            client, HEAD + b"Transfer-Encoding: chunked\r\n\r\n", *[piece] * 40, b"0\r\n\r\n"
        )
        assert b" 413 " in answered
        assert b"larger than 1 MB" in answered
        assert (await post(client, photo())).status == 200

    served(test, max_megabytes=1)


MALFORMED = {
    "TLS": b"\x16\x03\x01\x02\x00\x01\r\n\r\n",
    "a header without end": b"GET / HTTP/1.1\r\nHost: localhost\r\nA: "
    + b"b" * 20_000
    + b"\r\n\r\n",
    "headers without end": b"GET / HTTP/1.1\r\nHost: localhost\r\n" + b"A: b\r\n" * 5_000 + b"\r\n",
    "a length below zero": HEAD + b"Content-Length: -5\r\n\r\nabc",
    "two lengths": HEAD + b"Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\nabc",
    "a chunk of no size": HEAD + b"Transfer-Encoding: chunked\r\n\r\nzz\r\nabc",
}


@pytest.mark.parametrize("data", MALFORMED.values(), ids=MALFORMED)
def test_what_is_no_http_is_refused_without_a_word_on_the_terminal(
    data: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    async def test(client: Client, engine: Engine) -> None:
        assert b" 400 " in await raw(client, data)
        assert (await post(client, photo())).status == 200
        assert caplog.records == []

    served(test)


def test_an_upload_that_breaks_off_harms_nobody() -> None:
    async def test(client: Client, engine: Engine) -> None:
        for kind in (b"image/jpeg", b"multipart/form-data; boundary=x"):
            head = HEAD.replace(b"image/jpeg", kind)
            _, writer = await asyncio.open_connection(client.host, client.port)
            writer.write(head + b"Content-Length: 9999\r\n\r\n--x\r\n")
            await writer.drain()
            await asyncio.sleep(0.02)
            writer.close()
        assert (await post(client, photo())).status == 200
        assert "pvda_waiting_photos 0.0" in await (await client.get("/metrics")).text()

    served(test)


def test_a_client_that_asks_first_is_refused_before_it_sends_and_else_told_to_go_on() -> None:
    async def test(client: Client, engine: Engine) -> None:
        data = photo()
        reader, writer = await asyncio.open_connection(client.host, client.port)
        writer.write(HEAD + b"Expect: 100-continue\r\nContent-Length: %d\r\n\r\n" % len(data))
        assert await reader.readuntil(b"\r\n\r\n") == b"HTTP/1.1 100 Continue\r\n\r\n"
        writer.write(data)
        assert b"HTTP/1.1 200 OK" in await reader.readuntil(b"\r\n\r\n")
        writer.close()
        reader, writer = await asyncio.open_connection(client.host, client.port)
        writer.write(HEAD + b"Expect: 100-continue\r\nContent-Length: 2000000\r\n\r\n")
        assert b"HTTP/1.1 413 " in await reader.readuntil(b"\r\n\r\n")
        writer.close()

    served(test, max_megabytes=1)


def test_a_photo_that_does_not_arrive_is_not_waited_for() -> None:
    async def test(client: Client, engine: Engine) -> None:
        reader, writer = await asyncio.open_connection(client.host, client.port)
        writer.write(HEAD + b"Content-Length: 1000\r\n\r\n\xff\xd8\xff")
        assert b" 408 " in await reader.readuntil(b"\r\n\r\n")
        writer.close()
        assert (await post(client, photo())).status == 200

    served(test, upload_timeout_s=0.1)


def test_photos_beyond_the_queue_are_told_when_to_come_again_and_those_in_it_are_answered() -> None:
    async def test(client: Client, engine: Engine) -> None:
        engine.gate.clear()
        asked = [
            asyncio.create_task(post(client, photo())) for _ in range(5)
        ]  # 2 at work, 3 waiting
        while "pvda_waiting_photos 4.0" not in await (await client.get("/metrics")).text():
            await asyncio.sleep(0.01)  # the first went to work alone
        refused = await post(client, photo())
        assert 1 <= int(refused.headers["Retry-After"]) <= 60
        assert "5 photos are before it" in await said(refused, 503)
        engine.gate.set()
        assert [response.status for response in await asyncio.gather(*asked)] == [200] * 5
        assert (await post(client, photo())).status == 200

    served(test, batch=2, waiting=3)


def test_a_photo_whose_turn_would_come_too_late_is_told_so_at_once() -> None:
    async def test(client: Client, engine: Engine) -> None:
        engine.gate.clear()
        asked = [asyncio.create_task(post(client, photo())) for _ in range(3)]
        while "pvda_waiting_photos 2.0" not in await (await client.get("/metrics")).text():
            await asyncio.sleep(0.01)
        assert "before it" in await said(
            await post(client, photo()), 503
        )  # two batches of a guessed second each
        engine.gate.set()
        assert [response.status for response in await asyncio.gather(*asked)] == [200] * 3
        assert (await post(client, photo())).status == 200

    served(test, batch=1, timeout_s=1.9)


def test_an_answer_that_takes_too_long_is_not_waited_for() -> None:
    async def test(client: Client, engine: Engine) -> None:
        engine.gate.clear()
        assert "within 0.1 s" in await said(await post(client, photo()), 504)
        engine.gate.set()
        assert (await post(client, photo())).status == 200

    served(test, timeout_s=0.1)


def test_one_photo_that_kills_costs_those_beside_it_nothing() -> None:
    async def test(client: Client, engine: Engine) -> None:
        engine.gate.clear()
        first = asyncio.create_task(post(client, photo()))
        while not engine.asked:
            await asyncio.sleep(0.01)
        sizes = [(40, 30), (13, 13), (40, 30)]
        asked = [asyncio.create_task(post(client, photo(size=size))) for size in sizes]
        while "pvda_waiting_photos 3.0" not in await (await client.get("/metrics")).text():
            await asyncio.sleep(0.01)
        engine.gate.set()
        assert [response.status for response in await asyncio.gather(first, *asked)] == [
            200,
            200,
            422,
            200,
        ]
        assert len(engine.asked[1]) == 3

    served(test)


def test_health_says_what_is_loaded_or_why_nothing_is() -> None:
    async def test(client: Client, engine: Engine) -> None:
        response = await client.get("/health")
        body = await response.json()
        assert (response.status, body["ready"], body["rows"], body["fingerprint"]) == (
            200,
            True,
            3,
            "f" * 64,
        )
        engine.ready = False
        response = await client.get("/health")
        assert response.status == 503
        assert await response.json() == {"ready": False, "why": "the network is being loaded"}
        asked = await post(client, photo())
        assert asked.headers["Retry-After"] == "5"
        assert "the network is being loaded" in await said(asked, 503)

    served(test)


def test_metrics_count_requests_by_status_their_seconds_and_the_batches() -> None:
    async def test(client: Client, engine: Engine) -> None:
        for data in (photo(), photo(), b""):
            await post(client, data)
        await client.get("/no-such-path")
        text = await (await client.get("/metrics")).text()
        for line in (
            'pvda_requests_total{path="/locate",status="200"} 2.0', 'pvda_requests_total{path="/locate",status="400"} 1.0',
            'pvda_requests_total{path="other",status="404"} 1.0', 'pvda_request_seconds_count{path="/locate"} 3.0',
            'pvda_batch_photos_bucket{le="1.0"} 2.0', "pvda_waiting_photos 0.0",
        ):  # fmt: skip
            assert f"\n{line}\n" in text
        assert "no-such-path" not in text

    served(test)


def test_where_there_is_a_token_only_pages_and_health_go_without() -> None:
    async def test(client: Client, engine: Engine) -> None:
        for given in (
            "",
            "Bearer",
            "Bearer another-token-altogether",
            f"Basic {TOKEN}",
            f"Bearer {TOKEN}x",
            "Bearer ä",
        ):
            response = await post(client, photo(), **({"Authorization": given} if given else {}))
            assert response.headers["WWW-Authenticate"] == "Bearer"
            assert TOKEN not in await said(response, 401)
        assert (await client.get("/metrics")).status == 401
        assert (await post(client, photo(), Authorization=f"Bearer {TOKEN}")).status == 200
        for path in ("/", "/page.js", "/style.css", "/api", "/openapi.json", "/health"):
            assert (await client.get(path)).status == 200
        assert await (await client.get("/health")).json() == {"ready": True}
        assert (await client.get("/health", headers={"Host": "drones.example"})).status == 200
        trusted = await client.get("/health", headers={"Authorization": f"Bearer {TOKEN}"})
        assert (await trusted.json())["rows"] == 3

    served(test, token=TOKEN)


def test_the_description_names_every_path_and_nothing_else_and_the_page_says_the_same() -> None:
    async def test(client: Client, engine: Engine) -> None:
        document = await (await client.get("/openapi.json")).json()
        assert document["openapi"].startswith("3.1")
        router = client.server.service.app.router  # type: ignore[attr-defined]
        routes = {(one.method.lower(), one.resource.canonical) for one in router.routes()}
        pages = {"/", "/page.js", "/style.css", "/api", "/openapi.json"}
        described = {(verb, path) for path, calls in document["paths"].items() for verb in calls}
        assert described == {
            (verb, path) for verb, path in routes if path not in pages and verb != "head"
        }
        locate = document["paths"]["/locate"]["post"]
        assert {str(row[1]) for row in HOSTILE} - {"404", "405"} <= set(locate["responses"])
        answered = await (await post(client, photo())).json()
        assert set(answered) == set(document["components"]["schemas"]["Answer"]["properties"])
        assert set(answered["candidates"][0]) == set(
            document["components"]["schemas"]["Candidate"]["properties"]
        )
        health = await (await client.get("/health")).json()
        assert set(health) | {"why"} == set(
            document["components"]["schemas"]["Health"]["properties"]
        )
        page = await (await client.get("/api")).text()
        assert all(path in page for path in document["paths"])
        assert "16 MB" in page

    served(test, max_megabytes=16)


def test_pages_may_load_nothing_from_elsewhere_and_no_script_of_others() -> None:
    async def test(client: Client, engine: Engine) -> None:
        for path in ("/", "/api", "/health", "/no-such-path"):
            headers = (await client.get(path)).headers
            assert headers["Content-Security-Policy"].startswith(
                "default-src 'none'; script-src 'self';"
            )
            assert "unsafe" not in headers["Content-Security-Policy"]
            assert headers["X-Content-Type-Options"] == "nosniff"
            assert headers["Server"] == "pvda"

    served(test)


def test_an_unforeseen_failure_is_told_without_its_innards(
    capsys: pytest.CaptureFixture[str],
) -> None:
    async def test(client: Client, engine: Engine) -> None:
        engine.asked = None  # type: ignore[assignment]
        assert "AttributeError" not in await said(await post(client, photo()), 500)
        assert "AttributeError" in capsys.readouterr().err

    served(test)


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"host": "0.0.0.0"}, "--token-file"), ({"port": 70_000}, "--port"), ({"batch": 0}, "--batch"),
        ({"waiting": 0}, "--waiting"), ({"timeout_s": float("nan")}, "--timeout-s"), ({"max_megabytes": 0.0}, "--max-meg"),
    ],
)  # fmt: skip
def test_settings_that_are_none_are_refused(settings: dict[str, Any], word: str) -> None:
    with pytest.raises(InputError, match=word):
        ServiceSettings(**settings)


def test_a_token_is_a_files_first_line_and_not_too_short(tmp_path: Path) -> None:
    path = tmp_path / "token"
    path.write_text(f"{TOKEN}\nand a remark\n")
    assert ServiceSettings(host="0.0.0.0", token_file=str(path)).token() == TOKEN
    assert ServiceSettings().token() is None
    for text in ("", "short", "with blanks between words", "ümläute-sind-nicht-ascii"):
        path.write_text(text)
        with pytest.raises(InputError, match="16"):
            ServiceSettings(token_file=str(path)).token()
    with pytest.raises(InputError, match="no file at"):
        ServiceSettings(token_file=str(tmp_path / "none")).token()
