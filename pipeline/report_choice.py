"""Which queries of a task are shown: hits, misses, and one image beside all images of its place.

In: per-query rows of single queries and of merged ones. Out: rows, pairs of rows, and how often merging helps.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.chosen_rows import evenly
from pipeline.report_panels import MOSAIC, distance, is_hit, keys_shown, spread, sureness
from pipeline.report_tasks import TaskView

Row = Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class Pair:
    """A place asked for by one image and by all."""

    single: Row
    "Of the place's images the one whose true match ranks worst."
    merged: Row
    images: tuple[str, ...]
    "Keys of up to nine of its images, evenly chosen."


@dataclass(frozen=True, kw_only=True)
class Pairs:
    shown: tuple[Pair, ...]
    places: int
    "With at least one image that misses."
    mended: int
    "Of these, found first by all images together."
    lost: int
    "Places that every image alone finds first, and all together do not."


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Of one task."""

    task: TaskView
    hits: list[Row]
    "From the surest to the least sure."
    misses: list[Row]
    "From the farthest off to the nearly right."
    pairs: Pairs

    @property
    def keys(self) -> set[str]:
        """Of all images that its panels show."""
        rows = [*self.hits, *self.misses, *(row for pair in self.pairs.shown for row in (pair.single, pair.merged))]
        return keys_shown(rows) | {key for pair in self.pairs.shown for key in pair.images}


def choose(tasks: Sequence[TaskView], count: int) -> list[Choice]:
    """At most `count` hits, misses and pairs of each task of single queries."""
    single = [task for task in tasks if not task.row["multi_query"]]
    merged = {task.row["task"]: task.rows for task in tasks if task.row["multi_query"]}
    return [
        Choice(
            task=task,
            hits=spread([row for row in task.rows if is_hit(row)], count, sureness),
            misses=spread([row for row in task.rows if not is_hit(row)], count, distance),
            pairs=pair_up(task.rows, merged.get(task.row["task"], []), count),
        )
        for task in single
    ]


def pair_up(single: Sequence[Row], merged: Sequence[Row], count: int) -> Pairs:
    """At most `count` of the places with an image that misses, from the one that merging leaves farthest off to those that
    it finds first; evenly spaced in that order."""
    images: dict[str, list[Row]] = {}
    for row in sorted(single, key=lambda row: str(row["query"])):
        images.setdefault(row["location"], []).append(row)
    known = [row for row in merged if row["location"] in images]
    missed = [row for row in known if not all(is_hit(each) for each in images[row["location"]])]
    pairs = []
    for row in spread(missed, count, distance):
        of_place = images[row["location"]]
        keys = tuple(of_place[i]["query"] for i in evenly(len(of_place), MOSAIC))
        pairs.append(Pair(single=min(of_place, key=distance), merged=row, images=keys))
    return Pairs(
        shown=tuple(pairs),
        places=len(missed),
        mended=sum(map(is_hit, missed)),
        lost=sum(not is_hit(row) for row in known if row not in missed),
    )
