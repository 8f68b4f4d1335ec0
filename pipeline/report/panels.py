"""Which queries the report shows, and their pictures: per-query rows in, panels with thumbnails
out.

Shapes: P parts of an embedding, D its dimensions.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.features.table import Floats
from pipeline.images.thumbnails import ANSWER_PX, QUERY_PX, ThumbnailCache
from pipeline.retrieval.parts import cosines_by_part
from pipeline.retrieval.subsets import evenly_spaced

MAX_ANSWERS = 5
MOSAIC_IMAGES, MOSAIC_PX = 9, 96  # images that stand for a merged query, three a row


@dataclass(frozen=True, kw_only=True)
class PanelAnswer:
    """A gallery image under a query."""

    rank: int
    key: str
    location: str
    score: float
    right: bool
    picture: str | None
    "A data URI; None where the picture is not at hand."
    parts: tuple[float, ...] = ()
    "Cosine with the query part by part; empty where the embedding has no parts."


@dataclass(frozen=True, kw_only=True)
class Panel:
    """A query with its best answers."""

    key: str
    location: str
    pictures: tuple[str | None, ...]
    "One; of a merged query, up to nine of the images that it is the mean of."
    answers: tuple[PanelAnswer, ...]
    first_match_rank: int | None
    truth: PanelAnswer | None
    "The best true match, where it is not among the answers."


def is_hit(row: Mapping[str, Any]) -> bool:
    return bool(row["first_match_rank"] == 1)


def confidence_order(row: Mapping[str, Any]) -> tuple[float, str]:
    """Orders rows from the surest (highest best score) to the least sure."""
    return -row["top_scores"][0], row["query"]


def error_order(row: Mapping[str, Any]) -> tuple[float, str]:
    """Orders rows from the farthest off (no match at all, then the worst first rank) to the nearly
    right.
    """
    return -(row["first_match_rank"] or math.inf), row["query"]


def spread_over_locations(
    rows: Sequence[Mapping[str, Any]],
    count: int,
    order: Callable[[Mapping[str, Any]], tuple[float, str]],
) -> list[Mapping[str, Any]]:
    """`count` rows, evenly spaced in this order from its first to its last, of different locations
    if there are enough.

    Deterministic: the same rows give the same choice.
    """
    ordered = sorted(rows, key=order)
    first_of_location: dict[str, Mapping[str, Any]] = {}
    for row in ordered:
        first_of_location.setdefault(row["location"], row)
    pool = list(first_of_location.values()) if len(first_of_location) >= count else ordered
    return [pool[i] for i in evenly_spaced(len(pool), count)]


def panel_keys(rows: Iterable[Mapping[str, Any]]) -> set[str]:
    """Keys of all images on the panels of these rows."""
    keys: set[str] = set()
    for row in rows:
        keys |= {row["query"], *row["top_keys"][:MAX_ANSWERS]}
        keys |= {row["first_match_key"]} - {None}
    return keys


def make_panel(
    row: Mapping[str, Any], album: ThumbnailCache, vectors: Mapping[str, Floats] | None = None, parts: int = 1,
    merged: Sequence[str] = (),
) -> Panel:  # fmt: skip
    """One query's panel. `vectors`: embeddings (D,) by key, of `parts` parts; `merged`: keys of the
    images that the query is the mean of."""

    def answer(rank: int, key: str, location: str, score: float) -> PanelAnswer:
        asked, given = (vectors or {}).get(row["query"]), (vectors or {}).get(key)
        return PanelAnswer(
            rank=rank, key=key, location=location, score=score, right=location == row["location"],
            picture=album.get(key, ANSWER_PX),
            parts=() if parts < 2 or asked is None or given is None
            else tuple(cosines_by_part(asked[None], given[None], parts)[0].tolist()),
        )  # fmt: skip

    best = zip(row["top_keys"][:MAX_ANSWERS], row["top_locations"], row["top_scores"], strict=False)
    first, key = row["first_match_rank"], row["first_match_key"]
    apart = first is not None and first > MAX_ANSWERS
    shown = [(key, MOSAIC_PX) for key in merged] or [(row["query"], QUERY_PX)]
    return Panel(
        key=row["query"],
        location=row["location"],
        pictures=tuple(album.get(*each) for each in shown),
        answers=tuple(answer(rank, *each) for rank, each in enumerate(best, 1)),
        first_match_rank=first,
        truth=answer(first, key, row["location"], row["first_match_score"]) if apart else None,
    )
