"""What the service shows: the page for people, the one for programs, and the headers that keep both
to themselves.
"""

import json
from pathlib import Path

from aiohttp import web

from pipeline.core.templates import template_environment
from pipeline.service.openapi import openapi_document
from pipeline.service.settings import ServiceSettings

WEB_FOLDER = Path(__file__).parent / "web"
SECURITY_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
    "Server": "pvda",  # and no versions
}
"Of every answer."
PAGE_PATHS = ("/", "/page.js", "/style.css", "/api", "/openapi.json")


def page_routes(settings: ServiceSettings) -> list[web.RouteDef]:
    """The routes of PATHS, in their order."""
    shown = (
        ((WEB_FOLDER / "index.html").read_text(), "text/html"),
        ((WEB_FOLDER / "page.js").read_text(), "text/javascript"),
        ((WEB_FOLDER / "style.css").read_text(), "text/css"),
        (api_page(settings), "text/html"),
        (json.dumps(openapi_document(settings)), "application/json"),
    )
    return [_page(path, text, kind) for path, (text, kind) in zip(PAGE_PATHS, shown, strict=True)]


def _page(path: str, text: str, kind: str) -> web.RouteDef:
    async def answer(request: web.Request) -> web.Response:
        return web.Response(text=text, content_type=kind)

    return web.get(path, answer)


def api_page(settings: ServiceSettings) -> str:
    """The OpenAPI document as a page for people."""
    template = template_environment(WEB_FOLDER).get_template("api.html")
    return template.render(api=openapi_document(settings), port=settings.port)
