"""The JSON bodies of the service's responses.

Each body is made of dataclasses. `openapi.py` derives its schema from the same ones, so that the
published schemas and the responses cannot differ.
"""

from dataclasses import asdict, dataclass
from typing import Any

from pipeline.locate.locate import Answer
from pipeline.service.predictor import ServiceStatus


@dataclass(frozen=True, kw_only=True)
class AnswerTiming:
    """How long an answer took."""

    seconds: float
    "Seconds within the service, from the request's head to the answer."


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


def answer_body(answer: Answer, seconds: float) -> dict[str, Any]:
    return asdict(answer) | asdict(AnswerTiming(seconds=round(seconds, 4)))


def health_body(status: ServiceStatus | None, why: str | None, trusted: bool) -> dict[str, Any]:
    """With `status` ready, else not. An untrusted caller gets no details: they name the encoder and
    paths of this machine."""
    readiness = asdict(Readiness(ready=status is not None, why=why if trusted else None))
    details = asdict(status) if status and trusted else {}
    return {name: value for name, value in readiness.items() if value is not None} | details


def error_body(sentence: str) -> dict[str, Any]:
    return asdict(ErrorBody(error=sentence))
