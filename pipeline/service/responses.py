"""The JSON bodies of the service's responses.

Each body is made of dataclasses. `openapi.py` derives its schema from the same ones, so that the
published schemas and the responses cannot differ.
"""

from dataclasses import asdict, dataclass
from typing import Any

from pipeline.service.photo_map import Located, Pictures
from pipeline.service.predictor import ServiceStatus


@dataclass(frozen=True, kw_only=True)
class AnswerContext:
    """How long an answer took, and what can be shown with it."""

    seconds: float
    "Seconds within the service, from the request's head to the answer."
    match_seconds: float | None
    "Seconds of framing the photo and matching it with the map; null where it was not matched."
    pictures: Pictures
    "Which pixels of the gallery /tile and /map have: none, tiles, or a map of them as well."


@dataclass(frozen=True, kw_only=True)
class Readiness:
    """Whether the service can answer."""

    ready: bool
    "Whether the encoder and the index are loaded."
    why: str | None = None
    "Why it is not ready; only then."


@dataclass(frozen=True, kw_only=True)
class ErrorBody:
    """A request that was refused."""

    error: str
    "One sentence: what was found, what was expected, what to do."


def answer_body(located: Located, seconds: float) -> dict[str, Any]:
    match_s = located.match_seconds
    context = AnswerContext(
        seconds=round(seconds, 4),
        match_seconds=None if match_s is None else round(match_s, 4),
        pictures=located.pictures,
    )
    return asdict(located.answer) | asdict(context)


def health_body(status: ServiceStatus | None, why: str | None, trusted: bool) -> dict[str, Any]:
    """With `status` ready, else not. An untrusted caller gets no details: they name the encoder and
    paths of this machine."""
    readiness = asdict(Readiness(ready=status is not None, why=why if trusted else None))
    details = asdict(status) if status and trusted else {}
    return {name: value for name, value in readiness.items() if value is not None} | details


def error_body(sentence: str) -> dict[str, Any]:
    return asdict(ErrorBody(error=sentence))
