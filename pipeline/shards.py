"""Image records -> tar shards, a manifest, and the list of refused images.

In: records of a source. Out: `<split>-<view>-000000.tar` with the source's own bytes and a JSON per image,
`rejected.parquet`, and last of all `manifest.json`. The same input gives the same bytes whatever the parallelism.
"""

import hashlib
import json
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import IO, Any

import pyarrow as pa
import pyarrow.parquet as pq
import ray
import webdataset

from pipeline import cluster, storage
from pipeline.progress import console, progress
from pipeline.records import REJECTED_SCHEMA, ImageRecord, InputError, Rejection, Split, View
from pipeline.sources import name_of
from pipeline.sources.source import Source
from pipeline.transforms import DecodeError, decode

SCHEMA_VERSION = 1
MANIFEST, REJECTED = "manifest.json", "rejected.parquet"


@dataclass(frozen=True, kw_only=True)
class PackingSettings:
    """Which imagery becomes shards, and where."""

    root: str
    "Where the imagery is."
    out: str
    "Folder or URI for the shards."
    samples_per_shard: int = 1000
    "Images per tar."
    max_bad_fraction: float = 0.01
    "Refused images over all images; above it the job stops."

    def __post_init__(self) -> None:
        if self.samples_per_shard < 1:
            raise InputError(f"--samples-per-shard is {self.samples_per_shard}, expected at least 1")
        if not 0 <= self.max_bad_fraction <= 1:
            raise InputError(f"--max-bad-fraction is {self.max_bad_fraction}, expected a fraction from 0 to 1")


class TooManyRejected(RuntimeError):
    """More images were refused than `max_bad_fraction` allows."""


@dataclass(frozen=True, kw_only=True)
class Shard:
    """One tar as the manifest describes it."""

    name: str
    "Without `.tar`; a feature table's part has the same."
    split: Split
    view: View
    samples: int
    bytes: int
    sha256: str


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """What a set of shards holds."""

    shards: tuple[Shard, ...]
    classes: tuple[str, ...]
    "Locations of the training split, sorted: the classifier's outputs in order."
    packing: dict[str, Any]
    "What of the settings decides its content."
    rejected: int
    schema_version: int = SCHEMA_VERSION

    def of(self, split: Split | None = None, view: View | None = None) -> list[Shard]:
        """The shards of one split or one view (None: any)."""
        return [shard for shard in self.shards if split in (None, shard.split) and view in (None, shard.view)]


@dataclass(frozen=True, kw_only=True)
class ShardPlan:
    """A tar that is to be written."""

    name: str
    split: Split
    view: View
    records: tuple[ImageRecord, ...]


def plan_shards(records: Iterable[ImageRecord], samples_per_shard: int) -> tuple[list[ShardPlan], list[Rejection]]:
    """Divide records into shards, one split and view each, ordered by the hash of their keys.

    In that order any run of images is a fair sample of the whole: training shuffles well with a small buffer, and an
    index trains on the first parts. The second of two records with one key is refused.
    """
    keyed: dict[str, ImageRecord] = {}
    rejected = []
    for record in records:
        first = keyed.setdefault(record.key, record)
        if first is not record:
            rejected.append(Rejection(path=record.path, reason="same name twice", found=f"{first.path} has its key"))
    groups: dict[tuple[Split, View], list[tuple[str, ImageRecord]]] = defaultdict(list)
    for key, record in keyed.items():
        groups[record.split, record.view].append((hashlib.sha256(key.encode()).hexdigest(), record))
    plans = []
    for (split, view), members in sorted(groups.items()):
        ordered = [record for _, record in sorted(members, key=lambda member: member[0])]
        for number, start in enumerate(range(0, len(ordered), samples_per_shard)):
            part = tuple(ordered[start : start + samples_per_shard])
            plans.append(ShardPlan(name=f"{split}-{view}-{number:06d}", split=split, view=view, records=part))
    return plans, rejected


def write_shard(plan: ShardPlan, source: Source, out: str) -> tuple[Shard, list[Rejection]]:
    """Write one tar atomically; images that cannot be decoded are left out and returned."""
    rejected, samples = [], 0
    with storage.atomic(storage.join(out, f"{plan.name}.tar")) as stream:
        hashed = _Hashed(stream)
        # Fixed time, owner and mode: the same images give the same bytes.
        with webdataset.TarWriter(hashed, user="root", group="root", mode=0o644, mtime=0.0, encoder=False) as tar:
            for record in plan.records:
                try:
                    tar.write(read_sample(record, source))
                    samples += 1
                except DecodeError as error:
                    rejected.append(Rejection(path=record.path, reason=error.reason, found=error.found))
    shard = Shard(
        name=plan.name,
        split=plan.split,
        view=plan.view,
        samples=samples,
        bytes=hashed.bytes,
        sha256=hashed.digest.hexdigest(),
    )
    return shard, rejected


def read_sample(record: ImageRecord, source: Source) -> dict[str, Any]:
    """An image's bytes and JSON as a webdataset sample.

    Raises DecodeError when the bytes are no image.
    """
    try:
        data = source.read(record)
    except OSError as error:
        raise DecodeError("unreadable file", str(error)) from None
    height, width = decode(data).shape[:2]
    said = {
        "key": record.key, "location": record.location, "view": record.view, "split": record.split,
        "geotag": None if record.geotag is None else asdict(record.geotag),
        "source": name_of(source), "sha256": hashlib.sha256(data).hexdigest(), "width": width, "height": height,
    }  # fmt: skip
    return {"__key__": record.key, source.ending(record): data, "json": json.dumps(said, ensure_ascii=False).encode()}


class _Hashed:
    """A stream that counts and hashes what is written through it."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream, self.digest, self.bytes = stream, hashlib.sha256(), 0

    def write(self, data: bytes) -> int:
        self.digest.update(data)
        self.bytes += len(data)
        return self._stream.write(data)

    def tell(self) -> int:
        return self.bytes

    def flush(self) -> None:
        self._stream.flush()

    def close(self) -> None:
        """Whoever opened the stream closes it."""


def pack(source: Source, settings: PackingSettings) -> Manifest:
    """Pack a source's imagery; a finished set is left as it is.

    Raises InputError on unusable input, TooManyRejected when more than `max_bad_fraction` of the images are refused.
    """
    out = storage.absolute(settings.out)
    said = {
        "source": name_of(source),
        **json.loads(json.dumps(asdict(source))),
        "root": storage.absolute(settings.root),
        "samples_per_shard": settings.samples_per_shard,
    }
    if storage.exists(storage.join(settings.out, MANIFEST)):
        manifest = read_manifest(settings.out)
        if manifest.packing != said:
            changed = ", ".join(name for name in said if manifest.packing.get(name) != said[name])
            raise InputError(
                f"{settings.out} holds shards packed with another {changed}; choose another --out or delete it"
            )
        console.print(f"{settings.out} is complete: {len(manifest.shards)} shards; nothing to do")
        return manifest
    records: list[ImageRecord] = []
    rejected: list[Rejection] = []
    for found in source.scan(settings.root):
        if isinstance(found, Rejection):
            rejected.append(found)
        else:
            records.append(found)
    total = len(records) + len(rejected)
    plans, twice = plan_shards(records, settings.samples_per_shard)
    rejected += twice
    shards: list[Shard] = []
    cluster.connect()
    task = ray.remote(num_cpus=1)(write_shard)
    with progress(len(records), "packing") as meter:
        calls = cluster.bounded(lambda plan: task.remote(plan, source, out), plans, 2 * cluster.cpus())
        for plan, (shard, refused) in calls:
            shards.append(shard)
            rejected += refused
            meter.advance(len(plan.records), refused=len(rejected))
    write_rejected(settings.out, rejected)
    if len(rejected) > settings.max_bad_fraction * total:
        common = ", ".join(
            f"{reason} ({count})" for reason, count in Counter(r.reason for r in rejected).most_common(3)
        )
        raise TooManyRejected(
            f"{len(rejected)} of {total} images were refused, more than {settings.max_bad_fraction:.2%}: {common}; see "
            f"{storage.join(settings.out, REJECTED)}, mend them or raise --max-bad-fraction"
        )
    manifest = Manifest(
        shards=tuple(sorted(shards, key=lambda shard: shard.name)),
        classes=tuple(sorted({record.location for record in records if record.split == Split.TRAIN})),
        packing=said, rejected=len(rejected),
    )  # fmt: skip
    storage.write_json(storage.join(settings.out, MANIFEST), asdict(manifest))
    console.print(
        f"{settings.out}: {len(shards)} shards, {sum(s.samples for s in shards)} images, {len(rejected)} refused"
    )
    return manifest


def write_rejected(out: str, rejected: list[Rejection]) -> None:
    rows = [asdict(rejection) for rejection in sorted(rejected, key=lambda r: r.path)]
    with storage.atomic(storage.join(out, REJECTED)) as stream:
        pq.write_table(pa.Table.from_pylist(rows, REJECTED_SCHEMA), stream)


def read_manifest(shards: str) -> Manifest:
    """The manifest of a set of shards.

    Raises InputError when there is none or it cannot be read.
    """
    path = storage.join(shards, MANIFEST)
    if not storage.exists(path):
        raise InputError(f"no {MANIFEST} in {shards}: not a finished set of shards; make one with jobs/make_shards.py")
    try:
        said = storage.read_json(path)
        if said["schema_version"] != SCHEMA_VERSION:
            raise InputError(
                f"{path} has schema version {said['schema_version']}, expected {SCHEMA_VERSION}; pack again"
            )
        shard_list = tuple(
            Shard(**shard | {"split": Split(shard["split"]), "view": View(shard["view"])}) for shard in said["shards"]
        )
        return Manifest(**said | {"shards": shard_list, "classes": tuple(said["classes"])})
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}); delete it and run jobs/make_shards.py again") from None
