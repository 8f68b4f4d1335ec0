"""Requests that the service must refuse: name, status, a word of the sentence, and the request."""

import io
from collections.abc import Awaitable, Callable
from typing import Any

from tests.service.http_client import Client, form, post
from tests.service.photos import bomb, photo

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
