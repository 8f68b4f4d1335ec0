"""Which parts of an embedding find the place: retrieval by each part alone, and by all but one.

In: feature tables. Out: one row per part and way; none where the embedding has no parts.
"""

from collections.abc import Callable, Mapping
from typing import Any

from pipeline.breakdowns import measures_of
from pipeline.embedding_parts import parts_of_side, side_of_parts
from pipeline.features import FeatureTable
from pipeline.ranking import Blocks
from pipeline.ranking_workers import rank_spread
from pipeline.retrieval import Protocol, Task, sides_of


def measure_parts(
    task: Task,
    queries: FeatureTable,
    gallery: FeatureTable,
    protocol: Protocol = "full",
    workers: int = 0,
    advance: Callable[[int], None] = lambda scores: None,
    blocks: Blocks | None = None,
) -> list[dict[str, Any]]:
    """R@1, R@5 and AP with 95 % intervals, `kept` being "alone" (this part only) or "without" (all others).

    Of two parts the one without the other is that other alone, and is left out. Raises InputError as
    `retrieval.retrieve` does.
    """
    sides = sides_of(task, queries, gallery, protocol)
    parts = parts_of_side(sides[0])
    if parts < 2 or parts_of_side(sides[1]) != parts:
        return []
    every = tuple(range(parts))
    ways: list[tuple[str, int, tuple[int, ...]]] = [("alone", part, (part,)) for part in every]
    if parts > 2:
        ways += [("without", part, tuple(other for other in every if other != part)) for part in every]
    rows = []
    for kept, part, numbers in ways:
        asked, given = (side_of_parts(side, parts, numbers) for side in sides)
        found = rank_spread(asked, given, 0, workers, advance, blocks)
        named = {"task": task.name, "protocol": protocol, "parts": parts, "part": part + 1, "kept": kept}
        rows.append(named | measures_of(found.first_rank_Q, found.ap_Q, asked.locations))
    return rows


def part_label(row: Mapping[str, Any]) -> str:
    """What one of these rows is of, where "part" stands beside it."""
    return f"{row['part']} alone" if row["kept"] == "alone" else f"all but {row['part']}"
