"""Access control: which requests are answered at all, by their headers alone."""

import hmac

from aiohttp import web

from pipeline.service.pages import PAGE_PATHS
from pipeline.service.request import RequestError
from pipeline.service.settings import LOOPBACK_HOSTS

PUBLIC_PATHS = {*PAGE_PATHS, "/health"}
"""Paths that need no token: the pages, which reveal nothing of the index, and the path that a load
balancer polls."""


class AccessControl:
    """Checks the token, where the service requires one, and where a request comes from."""

    def __init__(self, token: str | None) -> None:
        self._token = token

    def check(self, request: web.BaseRequest) -> None:
        """Raise RequestError where this request may not be answered."""
        # DNS rebinding: a site's name that resolves to this machine has the same origin, for its
        # pages in a browser, as this service.
        host = request.host.rsplit(":", 1)[0].strip("[]")
        if self._token is None and host not in LOOPBACK_HOSTS:
            raise RequestError(
                403,
                f"the host is {host[:60]!r}, expected localhost; use that name, or start the "
                "service with --token-file",
            )
        public = request.path in PUBLIC_PATHS
        if request.headers.get("Sec-Fetch-Site") == "cross-site" and not public:
            raise RequestError(
                403,
                "sent by another site's page, expected the service's own; open the service itself",
            )
        if not public and not self.is_trusted(request):
            found = "another token" if "Authorization" in request.headers else "no token"
            raise RequestError(
                401,
                f"found {found}, expected the header Authorization: Bearer with the service's "
                "token",
            )

    def is_trusted(self, request: web.BaseRequest) -> bool:
        """Whether a request has the token, or none is required; compared in constant time."""
        given = request.headers.get("Authorization", "").encode("utf-8", "surrogateescape")
        return self._token is None or hmac.compare_digest(given, f"Bearer {self._token}".encode())
