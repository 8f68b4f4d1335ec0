"""The OpenAPI document against the service: paths, statuses, and the schemas of real responses."""

from collections.abc import Awaitable, Callable
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from pipeline.service.openapi import response_schemas
from pipeline.service.pages import type_name
from tests.service.hostile_requests import HOSTILE
from tests.service.http_client import TOKEN, Client, FakeEngine, post, run_with_service
from tests.service.photos import photo

pytestmark = pytest.mark.slow


async def published(client: Client) -> dict[str, Any]:
    document: dict[str, Any] = await (await client.get("/openapi.json")).json()
    return document


async def validate(client: Client, response: Any) -> dict[str, Any]:
    """The body of a response, valid by the schema published for its path and status, and without a
    property that the schema does not have."""
    document = await published(client)
    (call,) = document["paths"][response.url.path].values()
    content = call["responses"][str(response.status)]["content"]
    schema = content[response.content_type]["schema"]
    body: dict[str, Any] = await response.json()
    Draft202012Validator(schema | {"components": document["components"]}).validate(body)
    name = schema["$ref"].rpartition("/")[2]
    assert set(body) <= set(document["components"]["schemas"][name]["properties"])
    return body


def test_openapi_document_lists_every_path() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        document = await published(client)
        assert document["openapi"].startswith("3.1")
        router = client.server.service.app.router  # type: ignore[attr-defined]
        routes = {(one.method.lower(), one.resource.canonical) for one in router.routes()}
        pages = {"/", "/map.js", "/page.js", "/style.css", "/api", "/openapi.json"}
        described = {(verb, path) for path, calls in document["paths"].items() for verb in calls}
        assert described == {
            (verb, path) for verb, path in routes if path not in pages and verb != "head"
        }
        locate = document["paths"]["/locate"]["post"]
        assert {str(row[1]) for row in HOSTILE} - {"404", "405"} <= set(locate["responses"])
        page = await (await client.get("/api")).text()
        assert all(path in page for path in document["paths"])
        assert all(name in page for name in document["components"]["schemas"])
        assert "16 MB" in page

    run_with_service(test, max_megabytes=16)


@pytest.mark.parametrize("width", [40, 15], ids=["located", "nothing found"])
def test_answer_is_valid_by_its_published_schema(width: int) -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        body = await validate(client, await post(client, photo(size=(width, 30))))
        schemas = (await published(client))["components"]["schemas"]
        assert set(body) == set(schemas["Answer"]["properties"])
        assert set(schemas["Answer"]["required"]) == set(body)
        for candidate in body["candidates"]:
            assert set(candidate) == set(schemas["Hit"]["properties"])

    run_with_service(test)


def test_health_is_valid_by_its_published_schema() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        token = {"Authorization": f"Bearer {TOKEN}"}
        ready = await validate(client, await client.get("/health", headers=token))
        schemas = (await published(client))["components"]["schemas"]
        assert set(ready) | {"why"} == set(schemas["Health"]["properties"])
        assert set(await validate(client, await client.get("/health"))) == {"ready"}
        engine.ready = False
        assert set(await validate(client, await client.get("/health"))) == {"ready"}
        body = await validate(client, await client.get("/health", headers=token))
        assert set(body) == {"ready", "why"}

    run_with_service(test, token=TOKEN)


@pytest.mark.parametrize(
    "request_of",
    [row[3] for row in HOSTILE if row[1] not in (404, 405)],
    ids=[row[0] for row in HOSTILE if row[1] not in (404, 405)],
)
def test_error_is_valid_by_its_published_schema(
    request_of: Callable[[Client], Awaitable[Any]],
) -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        assert set(await validate(client, await request_of(client))) == {"error"}

    run_with_service(test, max_megabytes=1, max_megapixels=1)


def test_response_schemas_have_types_and_descriptions() -> None:
    schemas = response_schemas()
    assert {"Answer", "Health", "Error", "Position", "Hit"} <= set(schemas)
    for schema in schemas.values():
        assert all("description" in one for one in schema.get("properties", {}).values())
    properties = schemas["Answer"]["properties"]
    assert type_name(properties["position"]) == "Position or null"
    assert type_name(properties["candidates"]) == "list of Hit"
    assert type_name(properties["probability"]) == "number or null"
