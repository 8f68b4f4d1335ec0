"""Chooses the queries that the report shows: per-query rows in, panels with thumbnails out.

Shapes: P parts of an embedding, D its dimensions.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from pipeline.core.arrays import Floats
from pipeline.images.thumbnails import ANSWER_PX, QUERY_PX, ThumbnailCache
from pipeline.report.charts import Row
from pipeline.retrieval.parts import cosines_by_part
from pipeline.retrieval.subsets import evenly_spaced

MAX_ANSWERS = 5
MOSAIC_IMAGES, MOSAIC_PX = 9, 96  # images that stand for a merged query, three a row


@dataclass(frozen=True, kw_only=True)
class PanelAnswer:
    """A gallery image that a query ranks high."""

    rank: int
    key: str
    location: str
    score: float
    right: bool
    picture: str | None
    "A data URI; None without the image."
    parts: tuple[float, ...] = ()
    "Cosine with the query, part by part; empty if the embedding has no parts."


@dataclass(frozen=True, kw_only=True)
class Panel:
    """A query with its best answers."""

    key: str
    location: str
    pictures: tuple[str | None, ...]
    "One; for a merged query, up to nine of the images that it is the mean of."
    answers: tuple[PanelAnswer, ...]
    first_match_rank: int | None
    truth: PanelAnswer | None
    "The best true match, unless it is among the answers."


def is_hit(row: Row) -> bool:
    return bool(row["first_match_rank"] == 1)


def confidence_order(row: Row) -> tuple[float, str]:
    """Sort key: from the highest best score to the lowest."""
    return -row["top_scores"][0], row["query"]


def error_order(row: Row) -> tuple[float, str]:
    """Sort key: queries without a match, then from the worst first rank to the best."""
    return -(row["first_match_rank"] or math.inf), row["query"]


def spread_over_locations(
    rows: Sequence[Row],
    count: int,
    order: Callable[[Row], tuple[float, str]],
) -> list[Row]:
    """`count` rows, evenly spaced in this order from its first to its last, of different locations
    if there are enough.

    Deterministic: the same rows give the same choice.
    """
    ordered = sorted(rows, key=order)
    first_of_location: dict[str, Row] = {}
    for row in ordered:
        first_of_location.setdefault(row["location"], row)
    pool = list(first_of_location.values()) if len(first_of_location) >= count else ordered
    return [pool[i] for i in evenly_spaced(len(pool), count)]


def panel_keys(rows: Iterable[Row]) -> set[str]:
    """Keys of all images on the panels of these rows."""
    keys: set[str] = set()
    for row in rows:
        keys |= {row["query"], *row["top_keys"][:MAX_ANSWERS]}
        keys |= {row["first_match_key"]} - {None}
    return keys


def make_panel(
    row: Row,
    thumbnails: ThumbnailCache,
    vectors: Mapping[str, Floats] | None = None,
    parts: int = 1,
    merged: Sequence[str] = (),
) -> Panel:
    """One query's panel. `vectors`: embeddings (D,) by key, of `parts` parts; `merged`: keys of the
    images that the query is the mean of."""

    def answer(rank: int, key: str, location: str, score: float) -> PanelAnswer:
        query_D, answer_D = (vectors or {}).get(row["query"]), (vectors or {}).get(key)
        return PanelAnswer(
            rank=rank, key=key, location=location, score=score, right=location == row["location"],
            picture=thumbnails.get(key, ANSWER_PX),
            parts=() if parts < 2 or query_D is None or answer_D is None
            else tuple(cosines_by_part(query_D[None], answer_D[None], parts)[0].tolist()),
        )  # fmt: skip

    best = zip(row["top_keys"][:MAX_ANSWERS], row["top_locations"], row["top_scores"], strict=False)
    first, key = row["first_match_rank"], row["first_match_key"]
    apart = first is not None and first > MAX_ANSWERS
    shown = [(key, MOSAIC_PX) for key in merged] or [(row["query"], QUERY_PX)]
    return Panel(
        key=row["query"],
        location=row["location"],
        pictures=tuple(thumbnails.get(*each) for each in shown),
        answers=tuple(answer(rank, *each) for rank, each in enumerate(best, 1)),
        first_match_rank=first,
        truth=answer(first, key, row["location"], row["first_match_score"]) if apart else None,
    )
