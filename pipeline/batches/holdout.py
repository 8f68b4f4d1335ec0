"""Training locations that are not trained on, to look at what training does to places that it has
not seen.

In: the names of locations. Out: those held out, chosen by the hash of their names: the same
whatever else a set holds.
"""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import replace

from pipeline.core.errors import InputError
from pipeline.shards.manifest import Shard
from pipeline.shards.samples import read_locations


def holdout_locations(locations: Sequence[str], share: float) -> frozenset[str]:
    """About `share` of the locations.

    Raises InputError when fewer than two are held out or left to train on, unless the share is 0.
    """
    chosen = frozenset(location for location in locations if _place_in_line(location) < share)
    if share and not 2 <= len(chosen) <= len(locations) - 2:
        raise InputError(
            f"hold_out {share} holds out {len(chosen)} of {len(locations)} training locations; expected at least two held "
            "out and two to train on; choose another share, or 0 for none"
        )
    return chosen


def _place_in_line(location: str) -> float:
    """A number from 0 to below 1 that only the name decides."""
    return int.from_bytes(hashlib.sha256(location.encode()).digest()[:6]) / 2**48


def exclude_locations(
    shards: str, described: Iterable[Shard], locations: frozenset[str]
) -> list[Shard]:
    """The shards as if they did not hold these locations: their samples counted without them.

    Reads every shard's JSON files once; nothing where no location is left out.
    """
    if not locations:
        return list(described)
    return [replace(shard, samples=_count(shards, shard.name, locations)) for shard in described]


def _count(shards: str, name: str, locations: frozenset[str]) -> int:
    return sum(location not in locations for location in read_locations(shards, name))
