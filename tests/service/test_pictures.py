"""The routes of the gallery's pixels: who gets them, and how often they are computed."""

import pytest

from tests.service.http_client import TOKEN, Client, FakeEngine, error_sentence, run_with_service


def test_tile_is_computed_once_and_may_be_kept() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        for _ in range(2):
            response = await client.get("/tile?key=gallery-0")
            assert response.status == 200
            assert response.content_type == "image/webp"
            assert response.headers["Cache-Control"] == "private, max-age=600"
            assert (await response.read())[8:12] == b"WEBP"
        assert len(engine.pictures) == 1

    run_with_service(test)


def test_pictures_that_are_not_there_give_404() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        for path in ("/tile?key=gallery-1", "/map?lat=47&lon=8&half_m=50"):
            response = await client.get(path)
            assert response.headers["Cache-Control"] == "no-store"
            assert "--shards" in await error_sentence(response, 404)

    run_with_service(test)


@pytest.mark.parametrize(
    "path",
    [
        "/tile",
        "/tile?key=../../etc/passwd",
        "/tile?key=" + "a" * 201,
        "/map?lat=47&lon=8",
        "/map?lat=NaN&lon=8&half_m=50",
        "/map?lat=47&lon=8&half_m=1e9",
    ],
)
def test_picture_request_that_is_not_valid_is_refused(path: str) -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        assert "expected" in await error_sentence(await client.get(path), 400)
        assert engine.pictures == []

    run_with_service(test)


def test_pictures_need_the_token_and_the_services_own_page() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        for path in ("/tile?key=gallery-0", "/map?lat=47&lon=8&half_m=50"):
            assert (await client.get(path)).status == 401
            trusted = {"Authorization": f"Bearer {TOKEN}"}
            foreign = trusted | {"Sec-Fetch-Site": "cross-site"}
            assert (await client.get(path, headers=foreign)).status == 403
        assert engine.pictures == []
        assert (await client.get("/tile?key=gallery-0", headers=trusted)).status == 200

    run_with_service(test, token=TOKEN)


def test_pictures_not_ready_gives_503() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        engine.ready = False
        response = await client.get("/tile?key=gallery-0")
        assert response.headers["Retry-After"] == "5"
        await error_sentence(response, 503)

    run_with_service(test)
