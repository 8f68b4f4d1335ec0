"""The static pages: one for people, one that shows the OpenAPI document, and the headers of all
responses."""

import json
from pathlib import Path
from typing import Any

from aiohttp import web

from pipeline.core.templates import template_environment
from pipeline.service.openapi import openapi_document
from pipeline.service.settings import ServiceSettings

WEB_FOLDER = Path(__file__).parent / "web"
SECURITY_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' blob: data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
    "Server": "pvda",  # without versions
}
"Headers of every response."

PAGE_PATHS = ("/", "/map.js", "/page.js", "/style.css", "/api", "/openapi.json")


def page_routes(settings: ServiceSettings) -> list[web.RouteDef]:
    """The routes of PAGE_PATHS, in their order."""
    document = openapi_document(settings)
    pages = (
        ((WEB_FOLDER / "index.html").read_text(), "text/html"),
        ((WEB_FOLDER / "map.js").read_text(), "text/javascript"),
        ((WEB_FOLDER / "page.js").read_text(), "text/javascript"),
        ((WEB_FOLDER / "style.css").read_text(), "text/css"),
        (api_page(document, settings.port), "text/html"),
        (json.dumps(document), "application/json"),
    )
    return [
        _route(path, text, content_type)
        for path, (text, content_type) in zip(PAGE_PATHS, pages, strict=True)
    ]


def _route(path: str, text: str, content_type: str) -> web.RouteDef:
    async def respond(request: web.Request) -> web.Response:
        return web.Response(text=text, content_type=content_type)

    return web.get(path, respond)


def api_page(document: dict[str, Any], port: int) -> str:
    """The OpenAPI document as a page."""
    environment = template_environment(WEB_FOLDER)
    environment.filters["type_name"] = type_name
    return environment.get_template("api.html").render(api=document, port=port)


def type_name(schema: dict[str, Any]) -> str:
    """The type of a JSON schema in words."""
    if "anyOf" in schema:
        return " or ".join(type_name(choice) for choice in schema["anyOf"])
    if "$ref" in schema:
        return str(schema["$ref"].rpartition("/")[2])
    if schema.get("type") == "array":
        if "prefixItems" in schema:
            return f"list of {len(schema['prefixItems'])} values"
        return f"list of {type_name(schema['items'])}"
    return str(schema["type"])
