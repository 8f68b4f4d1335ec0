"""Which image goes into which tar: a pure function of the records.

In: records. Out: plans of shards, each of one split and view; records that cannot have a place.
"""

import hashlib
import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from pipeline.core.records import ImageRecord, Rejection, Split, View


@dataclass(frozen=True, kw_only=True)
class ShardPlan:
    """A tar that is to be written."""

    name: str
    "Without `.tar`."
    split: Split
    view: View
    records: tuple[ImageRecord, ...]

    def digest(self, said: Mapping[str, object]) -> str:
        """Hash of all that decides the tar's bytes, as far as it is known without reading the
        images.

        `said`: what of the settings matters to it. A file that was mended has another size, as a rule.
        """
        told = [said, self.name, self.records]
        return hashlib.sha256(json.dumps(told, sort_keys=True, default=vars).encode()).hexdigest()


@dataclass(frozen=True, kw_only=True)
class ShardSize:
    """Where a tar ends."""

    samples_per_shard: int = 1000
    "Images per tar at most."
    megabytes_per_shard: float | None = None
    """Bytes of images per tar at most, 1e6 each, by the sizes of files: None for any number. Tiles
    that are cut out of larger files have no size before they are cut, and count as nothing."""
    numbered_from: Mapping[tuple[Split, View], int] = field(default_factory=dict)
    "Number of the first new tar of a split and view, where there are some already."

    def parts(self, records: list[ImageRecord]) -> Iterator[tuple[ImageRecord, ...]]:
        """Records in runs of one tar each."""
        limit = float("inf") if self.megabytes_per_shard is None else self.megabytes_per_shard * 1e6
        part: list[ImageRecord] = []
        held = 0
        for record in records:
            size = record.bytes or 0
            if part and (len(part) >= self.samples_per_shard or held + size > limit):
                yield tuple(part)
                part, held = [], 0
            part.append(record)
            held += size
        if part:
            yield tuple(part)


def plan_shards(
    records: Iterable[ImageRecord], size: ShardSize
) -> tuple[list[ShardPlan], list[Rejection]]:
    """Divide records into shards, one split and view each, ordered by the hash of their keys.

    In that order any run of images is a fair sample of the whole: training shuffles well with a
    small buffer, and an index trains on the first parts. The second of two records with one key is
    refused.
    """
    keyed: dict[str, ImageRecord] = {}
    rejected = []
    for record in records:
        first = keyed.setdefault(record.key, record)
        if first is not record:
            rejected.append(
                Rejection(
                    path=record.name, reason="same name twice", found=f"{first.name} has its key"
                )
            )
    groups: dict[tuple[Split, View], list[tuple[str, ImageRecord]]] = defaultdict(list)
    for key, record in keyed.items():
        groups[record.split, record.view].append((hashlib.sha256(key.encode()).hexdigest(), record))
    plans = []
    for (split, view), members in sorted(groups.items()):
        ordered = [record for _, record in sorted(members, key=lambda member: member[0])]
        for number, part in enumerate(
            size.parts(ordered), size.numbered_from.get((split, view), 0)
        ):
            plans.append(
                ShardPlan(name=f"{split}-{view}-{number:06d}", split=split, view=view, records=part)
            )
    return plans, rejected
