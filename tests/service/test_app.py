"""Requests over HTTP: answers, the queue and its limits, health and metrics."""

import asyncio

import pytest

from pipeline.core.geo import Circle
from pipeline.service.request import LocateRequest
from tests.service.http_client import (
    Client,
    FakeEngine,
    error_sentence,
    form,
    post,
    run_with_service,
)
from tests.service.photos import photo


def test_locate_photo_as_body() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        response = await post(client, photo(), query="?top=2&lat=47&lon=8&radius_m=500")
        assert response.status == 200
        body = await response.json()
        position = {"lat": 47.0, "lon": 8.0, "radius_m": 25.0, "how": "tile", "ellipse": None}
        assert body["position"] == position
        assert (body["probability"], body["known"], body["location"]) == (0.8, True, "0000")
        assert [hit["key"] for hit in body["candidates"]] == ["gallery-0", "gallery-1"]
        assert body["seconds"] >= 0
        [[question]] = engine.batches
        assert question == LocateRequest(
            photo=photo(), near=Circle(lat=47, lon=8, radius_m=500), top=2
        )

    run_with_service(test)


def test_locate_form_fields_override_query() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        data = form(
            lat="47", lon="8", radius_m="500", top="3", photo=photo("PNG"), of_no_interest="1"
        )
        response = await client.post("/locate?top=9", data=data)
        assert response.status == 200, await response.text()
        [[question]] = engine.batches
        assert question == LocateRequest(
            photo=photo("PNG"), near=Circle(lat=47, lon=8, radius_m=500), top=3
        )

    run_with_service(test)


def test_locate_full_queue_gives_retry_after() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        engine.gate.clear()
        pending = [
            asyncio.create_task(post(client, photo())) for _ in range(5)
        ]  # 2 at work, 3 waiting
        while "pvda_waiting_photos 4.0" not in await (await client.get("/metrics")).text():
            await asyncio.sleep(0.01)  # the first went to work alone
        refused = await post(client, photo())
        assert 1 <= int(refused.headers["Retry-After"]) <= 60
        assert "5 photos are before it" in await error_sentence(refused, 503)
        engine.gate.set()
        assert [response.status for response in await asyncio.gather(*pending)] == [200] * 5
        assert (await post(client, photo())).status == 200

    run_with_service(test, batch=2, waiting=3)


def test_locate_queue_beyond_timeout_is_refused_at_once() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        engine.gate.clear()
        pending = [asyncio.create_task(post(client, photo())) for _ in range(3)]
        while "pvda_waiting_photos 2.0" not in await (await client.get("/metrics")).text():
            await asyncio.sleep(0.01)
        assert "before it" in await error_sentence(
            await post(client, photo()), 503
        )  # two batches of a guessed second each
        engine.gate.set()
        assert [response.status for response in await asyncio.gather(*pending)] == [200] * 3
        assert (await post(client, photo())).status == 200

    run_with_service(test, batch=1, timeout_s=1.9)


def test_locate_answer_timeout() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        engine.gate.clear()
        assert "within 0.1 s" in await error_sentence(await post(client, photo()), 504)
        engine.gate.set()
        assert (await post(client, photo())).status == 200

    run_with_service(test, timeout_s=0.1)


def test_locate_poisoned_photo_spares_its_batch() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        engine.gate.clear()
        first = asyncio.create_task(post(client, photo()))
        while not engine.batches:
            await asyncio.sleep(0.01)
        sizes = [(40, 30), (13, 13), (40, 30)]
        pending = [asyncio.create_task(post(client, photo(size=size))) for size in sizes]
        while "pvda_waiting_photos 3.0" not in await (await client.get("/metrics")).text():
            await asyncio.sleep(0.01)
        engine.gate.set()
        assert [response.status for response in await asyncio.gather(first, *pending)] == [
            200,
            200,
            422,
            200,
        ]
        assert len(engine.batches[1]) == 3

    run_with_service(test)


def test_health_ready_and_not_ready() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
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
        assert await response.json() == {"ready": False, "why": "the encoder is being loaded"}
        response = await post(client, photo())
        assert response.headers["Retry-After"] == "5"
        assert "the encoder is being loaded" in await error_sentence(response, 503)

    run_with_service(test)


def test_metrics_count_requests_and_batches() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        for data in (photo(), photo(), b""):
            await post(client, data)
        await client.get("/no-such-path")
        text = await (await client.get("/metrics")).text()
        for line in (
            'pvda_requests_total{path="/locate",status="200"} 2.0',
            'pvda_requests_total{path="/locate",status="400"} 1.0',
            'pvda_requests_total{path="other",status="404"} 1.0',
            'pvda_request_seconds_count{path="/locate"} 3.0',
            'pvda_batch_photos_bucket{le="1.0"} 2.0',
            "pvda_waiting_photos 0.0",
        ):
            assert f"\n{line}\n" in text
        assert "no-such-path" not in text

    run_with_service(test)


def test_unexpected_error_hides_traceback(
    capsys: pytest.CaptureFixture[str],
) -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        engine.batches = None  # type: ignore[assignment]
        assert "AttributeError" not in await error_sentence(await post(client, photo()), 500)
        assert "AttributeError" in capsys.readouterr().err

    run_with_service(test)
