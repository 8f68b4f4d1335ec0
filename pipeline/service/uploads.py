"""A request's body -> photo and fields, with limits on its size and its time that hold while it is
read.

Two forms: the photo alone as the body, fields in the query; or multipart/form-data with the photo
in the field `photo`.
"""

import asyncio

from aiohttp import MultipartReader, StreamReader, web
from aiohttp.http_exceptions import HttpProcessingError
from aiohttp.multipart import BodyPartReader

from pipeline.service.request import FIELDS, RequestError

PHOTO_FIELD = "photo"
MAX_PARTS = 16
MAX_FIELD_BYTES = 256
"Bytes of lat, lon, radius_m or top, and of any other field of a form."

FORM_OVERHEAD_BYTES = 65_536
"Bytes of a form beyond its photo: boundaries, headers, fields."

CHUNK_BYTES = 65_536


async def read_upload(
    request: web.Request, max_bytes: int, max_seconds: float
) -> tuple[bytes, dict[str, str]]:
    """The photo and the given ones of FIELDS; fields of the form override those of the query.

    Raises RequestError.
    """
    query = {name: request.query[name] for name in FIELDS if name in request.query}
    try:
        async with asyncio.timeout(max_seconds):
            if request.content_type == "multipart/form-data":
                photo, fields = await _read_form(request, max_bytes)
                return photo, query | fields
            return await _read_limited(request.content, max_bytes), query
    except TimeoutError:
        raise RequestError(
            408,
            f"the photo had not arrived after {max_seconds:.0f} s; send it again, or a smaller one",
        ) from None


def check_headers(request: web.BaseRequest, max_bytes: int) -> None:
    """Raise RequestError where the headers alone show that the body will be refused."""
    content_type = request.content_type
    is_form = content_type == "multipart/form-data"
    is_photo = content_type == "application/octet-stream" or content_type.startswith("image/")
    if not (is_form or is_photo):
        raise RequestError(
            415,
            f"the content type is {content_type[:60]}, expected image/jpeg, image/png, image/webp, "
            "application/octet-stream or multipart/form-data with the photo in the field "
            f"{PHOTO_FIELD}; send it with one of these",
        )
    if request.headers.get("Content-Encoding", "identity") != "identity":
        raise RequestError(
            415,
            "the body is compressed, expected the photo as it is; send it without Content-Encoding",
        )
    limit = max_bytes + (FORM_OVERHEAD_BYTES if is_form else 0)
    if request.content_length is not None and request.content_length > limit:
        raise photo_too_large(max_bytes)


def photo_too_large(max_bytes: int) -> RequestError:
    return RequestError(
        413, f"the photo is larger than {max_bytes / 1e6:g} MB; send a smaller copy of it"
    )


async def _read_limited(stream: StreamReader, max_bytes: int) -> bytes:
    """A whole stream; at most the limit and one chunk of it are in memory."""
    body = bytearray()
    async for chunk in stream.iter_chunked(CHUNK_BYTES):
        body += chunk
        if len(body) > max_bytes:
            raise photo_too_large(max_bytes)
    return bytes(body)


async def _read_form(request: web.Request, max_bytes: int) -> tuple[bytes, dict[str, str]]:
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
            data = await _read_part(
                part, max_bytes if part.name == PHOTO_FIELD else MAX_FIELD_BYTES
            )
            if part.name == PHOTO_FIELD:
                photo = data
            elif part.name in FIELDS:
                fields[part.name] = data.decode("utf-8", "replace")
        else:
            raise RequestError(
                400,
                f"the form has more than {MAX_PARTS - 1} fields; send the photo and "
                f"{', '.join(FIELDS)}",
            )
    except (ValueError, AssertionError, RuntimeError, HttpProcessingError) as error:
        # aiohttp raises all of these for damaged forms.
        reason = " ".join(str(error).split())[:120]
        raise RequestError(
            400, f"the form cannot be read: {reason}; send it as a browser does"
        ) from None
    if photo is None:
        raise RequestError(
            400, f"the form has no field {PHOTO_FIELD}, expected the photo there; see /api"
        )
    return photo, fields


async def _read_part(part: BodyPartReader, max_bytes: int) -> bytes:
    body = bytearray()
    while chunk := await part.read_chunk(CHUNK_BYTES):
        body += chunk
        if len(body) > max_bytes:
            if part.name == PHOTO_FIELD:
                raise photo_too_large(max_bytes)
            raise RequestError(
                400,
                f"the form's field {str(part.name)[:40]} is longer than {max_bytes} bytes; leave "
                "it out",
            )
    return bytes(body)
