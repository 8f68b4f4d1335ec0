"""A request's body -> photo and fields, with a limit on its size and on its time that holds while
it is read.

Two forms: the photo alone as the body, fields in the query; or multipart/form-data with the photo
in the field `photo`.
"""

import asyncio
from typing import Any

from aiohttp import MultipartReader, web
from aiohttp.http_exceptions import HttpProcessingError
from aiohttp.multipart import BodyPartReader

from pipeline.service.request import FIELDS, RequestError

PHOTO_FIELD = "photo"
MAX_PARTS = 16
MAX_FIELD_BYTES = 256
"Bytes of lat, lon, radius_m or top, and of whatever else a form sends along."
FORM_OVERHEAD_BYTES = 65_536
"Bytes of a form beyond those of its photo: boundaries, headers, fields."


async def read_upload(
    request: web.Request, max_bytes: int, most_seconds: float
) -> tuple[bytes, dict[str, str]]:
    """The photo and what of FIELDS is given; fields of the form stand before those of the query.

    Raises Refusal.
    """
    fields = {name: request.query[name] for name in FIELDS if name in request.query}
    try:
        async with asyncio.timeout(most_seconds):
            if request.content_type == "multipart/form-data":
                photo, given = await _form(request, max_bytes)
                return photo, fields | given
            return await _bounded(request.content, max_bytes), fields
    except TimeoutError:
        raise RequestError(
            408,
            f"the photo was not there after {most_seconds:.0f} s; send it again, or a smaller one",
        ) from None


def check_headers(request: web.BaseRequest, max_bytes: int) -> None:
    """Raise Refusal where the headers alone say that the body will not be taken."""
    kind = request.content_type
    if not (
        kind in ("multipart/form-data", "application/octet-stream") or kind.startswith("image/")
    ):
        raise RequestError(
            415,
            f"the content type is {kind[:60]}, expected image/jpeg, image/png, image/webp, application/octet-stream or "
            f"multipart/form-data with the photo in the field {PHOTO_FIELD}; say which it is",
        )
    if request.headers.get("Content-Encoding", "identity") != "identity":
        raise RequestError(
            415,
            "the body is compressed, expected the photo as it is; send it without Content-Encoding",
        )
    room = FORM_OVERHEAD_BYTES if kind == "multipart/form-data" else 0
    if (said := request.content_length) is not None and said > max_bytes + room:
        raise photo_too_large(max_bytes)


def photo_too_large(max_bytes: int) -> RequestError:
    return RequestError(
        413, f"the photo is larger than {max_bytes / 1e6:g} MB; send a smaller copy of it"
    )


async def _bounded(stream: Any, max_bytes: int) -> bytes:
    """All of a stream, never more than the limit and one chunk of it in memory."""
    body = bytearray()
    async for chunk in stream.iter_chunked(65_536):
        body += chunk
        if len(body) > max_bytes:
            raise photo_too_large(max_bytes)
    return bytes(body)


async def _form(request: web.Request, max_bytes: int) -> tuple[bytes, dict[str, str]]:
    photo: bytes | None = None
    fields = {}
    try:
        reader: MultipartReader = await request.multipart()
        for _ in range(MAX_PARTS):
            part = await reader.next()
            if part is None:
                break
            if not isinstance(part, BodyPartReader):
                raise RequestError(
                    400,
                    "the form holds another form, expected fields only; send the photo by itself",
                )
            data = await _part(part, max_bytes if part.name == PHOTO_FIELD else MAX_FIELD_BYTES)
            if part.name == PHOTO_FIELD:
                photo = data
            elif part.name in FIELDS:
                fields[part.name] = data.decode("utf-8", "replace")
        else:
            raise RequestError(
                400,
                f"the form has more than {MAX_PARTS - 1} fields; send the photo and {', '.join(FIELDS)}",
            )
    except (
        ValueError,
        AssertionError,
        RuntimeError,
        HttpProcessingError,
    ) as error:  # aiohttp's, over damaged forms
        why = " ".join(str(error).split())[:120]
        raise RequestError(
            400, f"the form cannot be read: {why}; send it as a browser does"
        ) from None
    if photo is None:
        raise RequestError(
            400, f"the form has no field {PHOTO_FIELD}, expected the photo there; see /api"
        )
    return photo, fields


async def _part(part: BodyPartReader, max_bytes: int) -> bytes:
    body = bytearray()
    while chunk := await part.read_chunk(65_536):
        body += chunk
        if len(body) > max_bytes:
            if part.name == PHOTO_FIELD:
                raise photo_too_large(max_bytes)
            raise RequestError(
                400,
                f"the form's field {str(part.name)[:40]} is longer than {max_bytes} bytes; leave it out",
            )
    return bytes(body)
