"""Uploads over HTTP: hostile, malformed, aborted and slow ones."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from tests.service.hostile_requests import HOSTILE
from tests.service.http_client import (
    HEAD,
    Client,
    FakeEngine,
    error_sentence,
    post,
    run_with_service,
    send_raw,
)
from tests.service.photos import photo

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("status", "word", "harm"), [row[1:] for row in HOSTILE], ids=[row[0] for row in HOSTILE]
)
def test_locate_hostile_request_is_refused(
    status: int, word: str, harm: Callable[[Client], Awaitable[Any]]
) -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        assert word in await error_sentence(await harm(client), status)
        assert (await post(client, photo())).status == 200

    run_with_service(test, max_megabytes=1, max_megapixels=1)


def test_upload_without_length_stops_at_limit() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        piece = b"10000\r\n" + bytes(65_536) + b"\r\n"
        answered = await send_raw(
            client, HEAD + b"Transfer-Encoding: chunked\r\n\r\n", *[piece] * 40, b"0\r\n\r\n"
        )
        assert b" 413 " in answered
        assert b"larger than 1 MB" in answered
        assert (await post(client, photo())).status == 200

    run_with_service(test, max_megabytes=1)


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
def test_malformed_http_is_refused_silently(data: bytes, caplog: pytest.LogCaptureFixture) -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        assert b" 400 " in await send_raw(client, data)
        assert (await post(client, photo())).status == 200
        assert caplog.records == []

    run_with_service(test)


def test_upload_aborted_leaves_queue_empty() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        for kind in (b"image/jpeg", b"multipart/form-data; boundary=x"):
            head = HEAD.replace(b"image/jpeg", kind)
            _, writer = await asyncio.open_connection(client.host, client.port)
            writer.write(head + b"Content-Length: 9999\r\n\r\n--x\r\n")
            await writer.drain()
            await asyncio.sleep(0.02)
            writer.close()
        assert (await post(client, photo())).status == 200
        assert "pvda_waiting_photos 0.0" in await (await client.get("/metrics")).text()

    run_with_service(test)


def test_expect_continue_is_answered_before_body() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
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

    run_with_service(test, max_megabytes=1)


def test_upload_timeout() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        reader, writer = await asyncio.open_connection(client.host, client.port)
        writer.write(HEAD + b"Content-Length: 1000\r\n\r\n\xff\xd8\xff")
        assert b" 408 " in await reader.readuntil(b"\r\n\r\n")
        writer.close()
        assert (await post(client, photo())).status == 200

    run_with_service(test, upload_timeout_s=0.1)
