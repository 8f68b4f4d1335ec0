"""Pairs of a UAV image and a satellite image of one location, for losses that compare the two.

In: a shuffled stream of UAV samples, and the set's satellite samples. Out: groups of pairs in which
each location comes once, so that any other row of the batch shows another place; or pairs of which
an epoch has a planned number of each location. Pure functions of the stream's order.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import TypeVar

import numpy as np

from pipeline.batches.kept import KeptShards
from pipeline.core.errors import InputError
from pipeline.shards.manifest import Shard
from pipeline.shards.samples import Sample

Item = TypeVar("Item")


def location_of(sample: Sample) -> str:
    """The location that a sample's metadata names."""
    return str(sample.metadata["location"])


def group_distinct(
    items: Iterable[Item], name_of: Callable[[Item], str], size: int
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
            if name_of(item) in group:
                postponed.append(item)
            else:
                group[name_of(item)] = item
        waiting = postponed + waiting
        yield list(group.values())


def plan_locations(
    locations: Sequence[str],
    repeats: int,
    rows: int,
    rank: int,
    world: int,
    rng: np.random.Generator,
) -> dict[str, int]:
    """How many rows of an epoch each location of a rank gets, `rows` in all.

    The locations in random order, the same on every rank, are cut into `world` equal stretches; a
    rank takes its own. Each of its locations gets `repeats` rows until there are `rows` of them, so
    the locations that are dropped differ from epoch to epoch.
    """
    share = len(locations) // world
    order = rng.permutation(len(locations))[rank * share : (rank + 1) * share]
    named = (locations[number] for number in order for _ in range(repeats))
    return Counter(islice(named, rows))


def take_planned(
    items: Iterable[Item], name_of: Callable[[Item], str], planned: Mapping[str, int], path: str
) -> Iterator[Item]:
    """As many items of each location as are planned, those of one location in a row, in the order
    in which the last of them comes. Other items are passed over. No item is read after the last
    planned one.

    Raises InputError where the items end before that; `path` names the set.
    """
    missing: dict[str, list[Item]] = {location: [] for location in planned}
    for item in items if missing else ():
        location = name_of(item)
        if location not in missing:
            continue
        missing[location].append(item)
        if len(missing[location]) == planned[location]:
            yield from missing.pop(location)
            if not missing:
                return
    if missing:
        raise InputError(
            f"{len(missing)} of {len(planned)} training locations of {path} have too few UAV "
            f"images ({min(missing)!r} and on), expected at least one of each to train on pairs; "
            "train with --sampler independent, or pack again"
        )


class SatelliteImages:
    """The encoded satellite images of a set by location, in memory: 40 kB each, as a rule.

    A location of University-1652 has one; where there are more, each pair gets one at random.
    """

    def __init__(
        self, kept: KeptShards, satellite: Sequence[Shard], left_out: frozenset[str]
    ) -> None:
        self._path, self._by_location = kept.shards.path, dict[str, list[Sample]]()
        for shard in satellite:
            for sample in kept.samples(shard):
                location = location_of(sample)
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
