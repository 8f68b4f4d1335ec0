"""Which image goes into which tar: a pure function of the records.

In: records. Out: plans of shards, each of one split and view, and the records that are refused.
"""

import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from pipeline.core.integrity import sha256_of
from pipeline.core.records import ImageRecord, Rejection, Split, View
from pipeline.shards.manifest import Manifest


@dataclass(frozen=True, kw_only=True)
class ShardPlan:
    """A tar to be written."""

    name: str
    "Without `.tar`."
    split: Split
    view: View
    records: tuple[ImageRecord, ...]

    def digest(self, config: Mapping[str, object]) -> str:
        """Hash of everything that determines the tar's bytes and is known without reading the
        images.

        `config`: the settings that matter to it. A file that was repaired has another size, as a
        rule.
        """
        content = [config, self.name, self.records]
        text = json.dumps(content, sort_keys=True, default=vars)
        return sha256_of(text.encode())


@dataclass(frozen=True, kw_only=True)
class ShardSize:
    """The size at which a tar ends."""

    samples_per_shard: int = 1000
    "Images per tar at most."
    megabytes_per_shard: float | None = None
    """Bytes of images per tar at most, 1e6 each, by the sizes of files: None for any number. Tiles
    that are cut out of larger files have no known size, and count as 0."""
    numbered_from: Mapping[tuple[Split, View], int] = field(default_factory=dict)
    "Number of the first new tar of a split and view, where there are some already."

    def parts(self, records: list[ImageRecord]) -> Iterator[tuple[ImageRecord, ...]]:
        """Records in runs of one tar each."""
        limit = float("inf") if self.megabytes_per_shard is None else self.megabytes_per_shard * 1e6
        part: list[ImageRecord] = []
        total = 0
        for record in records:
            size = record.bytes or 0
            if part and (len(part) >= self.samples_per_shard or total + size > limit):
                yield tuple(part)
                part, total = [], 0
            part.append(record)
            total += size
        if part:
            yield tuple(part)


def plan_shards(
    records: Iterable[ImageRecord], size: ShardSize
) -> tuple[list[ShardPlan], list[Rejection]]:
    """Divide records into shards, one split and view each, ordered by the hash of their keys.

    In that order any run of images is a fair sample of the set: training shuffles well with a
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
        groups[record.split, record.view].append((sha256_of(key.encode()), record))
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


def next_numbers(manifest: Manifest) -> dict[tuple[Split, View], int]:
    """Number of the first new tar of each split and view that the set has tars of."""
    after: dict[tuple[Split, View], int] = {}
    for shard in manifest.shards:
        number = int(shard.name.rsplit("-", 1)[1])
        after[shard.split, shard.view] = max(number + 1, after.get((shard.split, shard.view), 0))
    return after
