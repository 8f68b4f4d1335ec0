"""The OpenAPI 3.1 document of the service, made from the settings in force.

The schemas of the responses are derived by pydantic from the dataclasses of `responses.py`, with
their attribute docstrings as descriptions.
"""

from typing import Any

from pydantic import BaseModel, ConfigDict
from pydantic.json_schema import GenerateJsonSchema

from pipeline.locate.locate import Answer
from pipeline.service.pictures import MAX_HALF_M
from pipeline.service.predictor import ServiceStatus
from pipeline.service.request import DEFAULT_TOP, MAX_TOP
from pipeline.service.responses import AnswerContext, ErrorBody, Readiness
from pipeline.service.settings import ServiceSettings

REF = "#/components/schemas/"
REASONS = {
    "400": "The photo is empty, or a field is not valid.",
    "401": "The service requires a token, and the request has none or another one.",
    "403": "Sent by another site's page, or by a host name that is not this machine's.",
    "408": "The photo did not arrive in time.",
    "413": "Too many bytes or pixels.",
    "415": "Not a JPEG, PNG or WebP file.",
    "422": "A damaged photo.",
    "500": "The service failed.",
    "503": "Not ready, or too many photos wait; Retry-After has the seconds to wait.",
    "504": "No answer in time.",
}
FORM_FIELDS: dict[str, dict[str, Any]] = {
    "lat": {
        "type": "number",
        "minimum": -90,
        "maximum": 90,
        "description": "Rough position, degrees north, WGS84.",
    },
    "lon": {
        "type": "number",
        "minimum": -180,
        "maximum": 180,
        "description": "Degrees east.",
    },
    "radius_m": {
        "type": "number",
        "exclusiveMinimum": 0,
        "description": "Metres around it; gallery images beyond are not candidates.",
    },
    "top": {
        "type": "integer",
        "minimum": 1,
        "maximum": MAX_TOP,
        "default": DEFAULT_TOP,
        "description": "Candidates in the answer.",
    },
    "fov": {
        "type": "number",
        "minimum": 1,
        "maximum": 170,
        "description": "Field of view across the photo's width, degrees; overrules its tags, as "
        "the next three do.",
    },
    "height": {
        "type": "number",
        "exclusiveMinimum": 0,
        "description": "Height of the camera above the ground, metres.",
    },
    "heading": {
        "type": "number",
        "minimum": -360,
        "maximum": 360,
        "description": "Direction of the camera, degrees clockwise from north.",
    },
    "pitch": {
        "type": "number",
        "minimum": -90,
        "exclusiveMaximum": 0,
        "description": "Angle of the camera above the horizon, degrees: -90 looks straight down.",
    },
}


def openapi_document(settings: ServiceSettings) -> dict[str, Any]:
    """The OpenAPI document of a service with these settings."""
    document: dict[str, Any] = {
        "openapi": "3.1.0",
        "info": {
            "title": "Where was this photo taken?",
            "version": "1",
            "description": "Locates a photo in an index of images with known positions.",
        },
        "paths": {
            "/locate": {"post": _locate(settings)},
            "/health": {"get": _health()},
            "/tile": {"get": _tile()},
            "/map": {"get": _map()},
            "/metrics": {"get": _metrics()},
        },
        "components": {"schemas": response_schemas()},
    }
    if settings.token_file is not None:
        document["components"]["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
        document["security"] = [{"token": []}]
    return document


def _locate(settings: ServiceSettings) -> dict[str, Any]:
    photo = {"type": "string", "format": "binary", "description": "The photo."}
    types = ("image/jpeg", "image/png", "image/webp", "application/octet-stream")
    form = {"type": "object", "required": ["photo"], "properties": {"photo": photo} | FORM_FIELDS}
    content = {"multipart/form-data": {"schema": form}}
    errors = {status: _json(reason, "Error") for status, reason in REASONS.items()}
    return {
        "summary": "Where was this photo taken?",
        "description": "The photo is the whole body, with the fields in the query; or the field "
        "photo of a form, with the others beside it. JPEG, PNG or WebP, at most "
        f"{settings.max_megabytes:g} MB and {settings.max_megapixels:g} megapixels. Rough "
        "position: all of lat, lon and radius_m or none.",
        "parameters": [_query_parameter(name, schema) for name, schema in FORM_FIELDS.items()],
        "requestBody": {
            "required": True,
            "content": content | {name: {"schema": photo} for name in types},
        },
        "responses": {"200": _json("The answer.", "Answer")} | errors,
    }


def _query_parameter(name: str, schema: dict[str, Any]) -> dict[str, Any]:
    schema = dict(schema)
    description = schema.pop("description")
    return {
        "name": name,
        "in": "query",
        "required": False,
        "description": description,
        "schema": schema,
    }


def _health() -> dict[str, Any]:
    return {
        "summary": "Is it ready?",
        "description": "Ready when encoder and index are loaded. Where the service requires a "
        "token, only a request with it gets more than `ready`.",
        "security": [],
        "responses": {
            "200": _json("Ready.", "Health"),
            "503": _json("Not ready yet; the field why has the reason.", "Health"),
        },
    }


def _tile() -> dict[str, Any]:
    key = {"type": "string", "description": "Key of a candidate."}
    return {
        "summary": "A gallery image, small",
        "description": "Where the service was started with --shards.",
        "parameters": [_query_parameter("key", key) | {"required": True}],
        "responses": _picture("The image, at most 180 pixels a side."),
    }


def _map() -> dict[str, Any]:
    degrees: dict[str, Any] = {"type": "number", "description": "Of the middle, degrees, WGS84."}
    half_m: dict[str, Any] = {
        "type": "number",
        "minimum": 1,
        "maximum": MAX_HALF_M,
        "description": "Half of its side, metres.",
    }
    parameters = {"lat": degrees, "lon": degrees, "half_m": half_m}
    return {
        "summary": "The map around a position",
        "description": "A square of ground, north up, put together from the gallery's images; "
        "transparent where none shows it. For shards whose images know their corners.",
        "parameters": [
            _query_parameter(name, schema) | {"required": True}
            for name, schema in parameters.items()
        ],
        "responses": _picture("The square, at most 640 pixels a side."),
    }


def _picture(description: str) -> dict[str, Any]:
    content = {"image/webp": {"schema": {"type": "string", "format": "binary"}}}
    reasons = {status: REASONS[status] for status in ("400", "401", "403", "500", "503", "504")}
    reasons |= {"404": "The gallery has no such image, or shows no ground there."}
    errors = {status: _json(reason, "Error") for status, reason in sorted(reasons.items())}
    return {"200": {"description": description, "content": content}} | errors


def _metrics() -> dict[str, Any]:
    content = {"text/plain": {"schema": {"type": "string"}}}
    return {
        "summary": "Counters",
        "description": "Requests by status, latency, sizes of batches, photos waiting, answers by "
        "how they came about, seconds of matching.",
        "responses": {"200": {"description": "Prometheus' text format.", "content": content}},
    }


def _json(description: str, schema: str) -> dict[str, Any]:
    content = {"application/json": {"schema": {"$ref": f"{REF}{schema}"}}}
    return {"description": description, "content": content}


class _Bodies(BaseModel):
    """All dataclasses that bodies of responses are made of."""

    model_config = ConfigDict(
        use_attribute_docstrings=True, json_schema_serialization_defaults_required=True
    )

    answer: Answer
    context: AnswerContext
    readiness: Readiness
    status: ServiceStatus
    error: ErrorBody


class _WithoutTitles(GenerateJsonSchema):
    """A field's title would repeat its name."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def response_schemas() -> dict[str, Any]:
    """JSON schemas of the bodies: Answer, Health, Error, and the parts that these refer to."""
    schemas: dict[str, Any] = _Bodies.model_json_schema(
        ref_template=REF + "{model}", schema_generator=_WithoutTitles, mode="serialization"
    )["$defs"]
    answer, context = schemas.pop("Answer"), schemas.pop("AnswerContext")
    readiness, status = schemas.pop("Readiness"), schemas.pop("ServiceStatus")
    bodies = {"Answer": _merge(answer, context), "Health": _merge(readiness, status)}
    bodies["Health"]["required"] = ["ready"]  # without the token, or a reason, only that is sent
    return bodies | {"Error": schemas.pop("ErrorBody")} | schemas


def _merge(first: dict[str, Any], second: dict[str, Any]) -> dict[str, Any]:
    """The schema of an object with the properties of both."""
    return first | {
        "properties": first["properties"] | second["properties"],
        "required": first["required"] + second["required"],
    }
