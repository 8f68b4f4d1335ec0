"""Which queries the report shows, and their pictures: per-query rows in, panels with thumbnails out."""

import base64
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from PIL import Image

from pipeline.transforms import DecodeError, decode

QUERY_PX = 360
ANSWER_PX = 180
PANELS = 4  # hits and as many misses for each task
ANSWERS = 5


@dataclass(frozen=True, kw_only=True)
class Answer:
    """A gallery image under a query."""

    rank: int
    key: str
    location: str
    score: float
    right: bool
    picture: str | None
    "A data URI; None where the picture is not at hand."


@dataclass(frozen=True, kw_only=True)
class Panel:
    """A query with its best answers."""

    key: str
    location: str
    picture: str | None
    answers: tuple[Answer, ...]
    first_match_rank: int | None
    truth: Answer | None
    "The best true match, where it is not among the answers."


def is_hit(row: Mapping[str, Any]) -> bool:
    return bool(row["first_match_rank"] == 1)


def sureness(row: Mapping[str, Any]) -> tuple[float, str]:
    """Orders rows from the surest (highest best score) to the least sure."""
    return -row["top_scores"][0], row["query"]


def distance(row: Mapping[str, Any]) -> tuple[float, str]:
    """Orders rows from the farthest off (no match at all, then the worst first rank) to the nearly right."""
    return -(row["first_match_rank"] or math.inf), row["query"]


def spread(
    rows: Sequence[Mapping[str, Any]], count: int, order: Callable[[Mapping[str, Any]], tuple[float, str]]
) -> list[Mapping[str, Any]]:
    """`count` rows, evenly spaced in this order from its first to its last, of different locations if there are enough.

    Deterministic: the same rows give the same choice.
    """
    ordered = sorted(rows, key=order)
    first_of_location: dict[str, Mapping[str, Any]] = {}
    for row in ordered:
        first_of_location.setdefault(row["location"], row)
    pool = list(first_of_location.values()) if len(first_of_location) >= count else ordered
    if len(pool) <= count:
        return pool
    return [pool[round(i * (len(pool) - 1) / (count - 1))] for i in range(count)]


def keys_shown(rows: Iterable[Mapping[str, Any]]) -> set[str]:
    """Keys of all pictures on the panels of these rows."""
    keys: set[str] = set()
    for row in rows:
        keys |= {row["query"], *row["top_keys"][:ANSWERS]}
        keys |= {row["first_match_key"]} - {None}
    return keys


def make_panel(row: Mapping[str, Any], images: Mapping[str, bytes]) -> Panel:
    """One query's panel."""
    best = zip(row["top_keys"], row["top_locations"], row["top_scores"], strict=True)
    answers = tuple(
        Answer(rank=rank, key=key, location=location, score=score, right=location == row["location"],
               picture=thumbnail(images.get(key), ANSWER_PX))
        for rank, (key, location, score) in enumerate(best, 1) if rank <= ANSWERS
    )  # fmt: skip
    first, key = row["first_match_rank"], row["first_match_key"]
    truth = None
    if first is not None and first > ANSWERS:
        truth = Answer(rank=first, key=key, location=row["location"], score=row["first_match_score"], right=True,
                       picture=thumbnail(images.get(key), ANSWER_PX))  # fmt: skip
    return Panel(
        key=row["query"], location=row["location"], picture=thumbnail(images.get(row["query"]), QUERY_PX),
        answers=answers, first_match_rank=first, truth=truth,
    )  # fmt: skip


def thumbnail(data: bytes | None, pixels: int) -> str | None:
    """A small JPEG as a data URI; None without a picture that can be read."""
    if data is None:
        return None
    try:
        image = Image.fromarray(decode(data))
    except DecodeError:
        return None
    image.thumbnail((pixels, pixels), Image.Resampling.LANCZOS)
    stream = io.BytesIO()
    image.save(stream, "JPEG", quality=82, optimize=True)
    return f"data:image/jpeg;base64,{base64.b64encode(stream.getvalue()).decode()}"
