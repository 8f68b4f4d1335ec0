"""Pairs of a UAV image and a satellite image of one location, for losses that compare the two.

In: a shuffled stream of UAV samples, and the set's satellite samples. Out: groups of pairs in which
each location comes once: any other row of the batch then shows another place. Pure functions of
the stream's order.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TypeVar

import numpy as np

from pipeline.core.errors import InputError
from pipeline.shards.manifest import Shard
from pipeline.shards.samples import Sample
from pipeline.shards.shard_set import ShardSet

Item = TypeVar("Item")


def group_distinct(
    items: Iterable[Item], location_of: Callable[[Item], str], size: int
) -> Iterator[list[Item]]:
    """Groups of `size` items of distinct locations, in the order in which they come; an item whose
    location is in the group already waits for the next one.

    Nothing but a last, partial group is lost. Waiting items are few where the stream is shuffled.
    """
    source, waiting = iter(items), deque[Item]()
    while True:
        group: dict[str, Item] = {}
        postponed = deque[Item]()
        while len(group) < size:
            item = waiting.popleft() if waiting else next(source, None)
            if item is None:
                return
            if location_of(item) in group:
                postponed.append(item)
            else:
                group[location_of(item)] = item
        waiting = postponed + waiting
        yield list(group.values())


class SatelliteImages:
    """The encoded satellite images of a set by location, in memory: 40 kB each, as a rule.

    A location of University-1652 has one; where there are more, each pair gets one at random.
    """

    def __init__(
        self, shards: ShardSet, satellite: Sequence[Shard], left_out: frozenset[str]
    ) -> None:
        self._path, self._by_location = shards.path, dict[str, list[Sample]]()
        for shard in satellite:
            for sample in shards.samples(shard):
                location = sample.metadata["location"]
                if location not in left_out:
                    self._by_location.setdefault(location, []).append(sample)

    def one_of(self, location: str, rng: np.random.Generator) -> Sample:
        """A satellite image of the location. Raises InputError where it has none."""
        found = self._by_location.get(location)
        if found is None:
            raise InputError(
                f"location {location!r} of {self._path} has UAV images and no satellite image, "
                "expected both to train on pairs; train with --sampler independent, or pack again"
            )
        return found[int(rng.integers(len(found)))]
