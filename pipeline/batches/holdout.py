"""Training locations that are held out of training, to measure it on places that it has not seen.

In: the names of locations. Out: the held-out ones, chosen by the hash of their names: the same
whatever else a set holds.
"""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import replace

from pipeline.core.errors import InputError
from pipeline.shards.manifest import Shard
from pipeline.shards.shard_set import ShardSet


def holdout_locations(locations: Sequence[str], share: float) -> frozenset[str]:
    """About `share` of the locations.

    Raises InputError when fewer than two are held out or left to train on, unless the share is 0.
    """
    chosen = frozenset(location for location in locations if _hash_fraction(location) < share)
    if share and not 2 <= len(chosen) <= len(locations) - 2:
        raise InputError(
            f"hold_out {share} holds out {len(chosen)} of {len(locations)} training locations; "
            "expected at least two held out and two to train on; choose another share, or 0 for "
            "none"
        )
    return chosen


def _hash_fraction(location: str) -> float:
    """A number from 0 to below 1 that depends on the name alone."""
    return int.from_bytes(hashlib.sha256(location.encode()).digest()[:6]) / 2**48


def exclude_locations(
    shards: ShardSet, described: Iterable[Shard], locations: frozenset[str]
) -> list[Shard]:
    """The shards with their samples counted without these locations.

    Reads every shard's JSON files once; reads nothing where no location is left out.
    """
    if not locations:
        return list(described)
    return [
        replace(shard, samples=sum(found not in locations for found in shards.locations(shard)))
        for shard in described
    ]
