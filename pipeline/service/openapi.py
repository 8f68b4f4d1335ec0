"""What the service offers, as OpenAPI 3.1 and as a page that says the same. Both are made here,
from the settings in force.
"""

from typing import Any

from pipeline.service.request import DEFAULT_TOP, MAX_TOP
from pipeline.service.settings import ServiceSettings

NUMBER, TEXT = {"type": "number"}, {"type": "string"}
MAYBE = {"type": ["number", "null"]}
ERROR = {"application/json": {"schema": {"$ref": "#/components/schemas/Error"}}}
REASONS = {
    "400": "Empty, or a field that is none.",
    "401": "A token is asked for and this is not it.",
    "403": "Another site's page asks, or by a name that is not this machine's.",
    "408": "The photo did not arrive in time.",
    "413": "Too many bytes or pixels.",
    "415": "No JPEG, PNG or WebP.",
    "422": "A damaged photo.",
    "500": "The service failed.",
    "503": "Not ready, or too many photos wait; Retry-After says for how many seconds.",
    "504": "No answer in time.",
}


def openapi_document(settings: ServiceSettings) -> dict[str, Any]:
    """The OpenAPI document of a service with these settings."""
    fields = {
        "lat": {
            "type": "number",
            "minimum": -90,
            "maximum": 90,
            "description": "Rough position, degrees north, WGS84.",
        },
        "lon": {"type": "number", "minimum": -180, "maximum": 180, "description": "Degrees east."},
        "radius_m": {
            "type": "number",
            "exclusiveMinimum": 0,
            "description": "How rough, metres; none beyond is a candidate.",
        },
        "top": {
            "type": "integer",
            "minimum": 1,
            "maximum": MAX_TOP,
            "default": DEFAULT_TOP,
            "description": "Candidates in the answer.",
        },
    }
    photo = {"type": "string", "format": "binary", "description": "The photo."}
    kinds = ("image/jpeg", "image/png", "image/webp", "application/octet-stream")
    locate = {
        "summary": "Where was this photo taken?",
        "description": "The photo is the whole body, with the fields in the query; or the field photo of a form, with the "
        f"others beside it. JPEG, PNG or WebP, at most {settings.max_megabytes:g} MB and {settings.max_megapixels:g} "
        "megapixels. Rough position: all of lat, lon and radius_m or none.",
        "parameters": [
            {
                "name": name,
                "in": "query",
                "required": False,
                "description": schema["description"],
                "schema": {key: value for key, value in schema.items() if key != "description"},
            }
            for name, schema in fields.items()
        ],
        "requestBody": {
            "required": True,
            "content": {
                "multipart/form-data": {
                    "schema": {
                        "type": "object",
                        "required": ["photo"],
                        "properties": {"photo": photo} | fields,
                    },
                },
            }
            | {kind: {"schema": photo} for kind in kinds},
        },
        "responses": {"200": _answers("The answer.", "Answer")}
        | {status: {"description": why, "content": ERROR} for status, why in REASONS.items()},
    }
    health = {
        "summary": "Is it ready?",
        "description": "Ready when network and index are loaded. Where there is a token, only who brings it is told more.",
        "security": [],
        "responses": {
            "200": _answers("Ready.", "Health"),
            "503": _answers("Not ready yet; the field why says why.", "Health"),
        },
    }
    metrics = {
        "summary": "What it counts",
        "description": "Requests by status, latency, sizes of batches, photos waiting.",
        "responses": {
            "200": {
                "description": "Prometheus' text format.",
                "content": {"text/plain": {"schema": TEXT}},
            }
        },
    }
    document: dict[str, Any] = {
        "openapi": "3.1.0",
        "info": {
            "title": "Where was this photo taken?",
            "version": "1",
            "description": "An index of images of known places.",
        },
        "paths": {
            "/locate": {"post": locate},
            "/health": {"get": health},
            "/metrics": {"get": metrics},
        },
        "components": {"schemas": _schemas()},
    }
    if settings.token_file is not None:
        document["components"]["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
        document["security"] = [{"token": []}]
    return document


def _answers(description: str, schema: str) -> dict[str, Any]:
    return {
        "description": description,
        "content": {"application/json": {"schema": {"$ref": f"#/components/schemas/{schema}"}}},
    }


def _object(required: bool = True, **properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties} | (
        {"required": list(properties)} if required else {}
    )


def _says(schema: dict[str, Any], description: str) -> dict[str, Any]:
    return schema | {"description": description}


def _schemas() -> dict[str, Any]:
    position = _object(
        lat=_says(NUMBER, "Degrees north, WGS84."),
        lon=_says(NUMBER, "Degrees east."),
        radius_m=_says(NUMBER, "Uncertainty, if the place is right."),
    )
    candidate = _object(
        key=_says(TEXT, "The gallery image."), location=_says(TEXT, "The place that it shows."),
        view=_says(TEXT, "From where it was taken: satellite, drone, street or google."),
        lat=MAYBE, lon=MAYBE, score=_says(NUMBER, "Cosine similarity, -1 to 1."),
    )  # fmt: skip
    answer = _object(
        position={"oneOf": [{"$ref": "#/components/schemas/Position"}, {"type": "null"}]},
        location=_says({"type": ["string", "null"]}, "The place's name."),
        probability=_says(MAYBE, "That the place is right; null without a calibration."),
        known=_says({"type": "boolean"}, "False: none of the gallery's places fits."),
        candidates=_says(
            {"type": "array", "items": {"$ref": "#/components/schemas/Candidate"}}, "Best first."
        ),
        agreeing=_says(
            {"type": "integer"}, "How many of the candidates considered lie at the place."
        ),
        seconds=_says(NUMBER, "Within the service, from head to answer."),
    )
    health = _object(
        required=False,
        ready={"type": "boolean"},
        why=_says(TEXT, "Why it is not."),
        fingerprint=_says(TEXT, "Of network, settings and preprocessing."),
        rows=_says({"type": "integer"}, "Of the index in use."),
        factory=_says(TEXT, "How FAISS holds them."),
        calibrated=_says({"type": "boolean"}, "Whether answers have a probability."),
        refused=_says({"type": ["string", "null"]}, "Why the newest index is not in use."),
    )
    error = _object(
        error=_says(TEXT, "One sentence: what was found, what was expected, what to do.")
    )
    return {
        "Position": position,
        "Candidate": candidate,
        "Answer": answer,
        "Health": health,
        "Error": error,
    }
