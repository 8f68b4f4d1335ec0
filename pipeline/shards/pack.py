"""Imagery -> shards: the stage. Tars are packed by Ray tasks, several at once; what is there
already is left as it is.

In: a source and a root. Out: tars, their record table, `rejected.parquet`, and last of all
`manifest.json`. The same input gives the same bytes whatever the parallelism, and however often
packing was killed and begun again.
"""

import json
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import ray

from pipeline.core import cluster, json_files, rejections, storage
from pipeline.core.errors import Incomplete, InputError
from pipeline.core.lock import locks_output
from pipeline.core.progress import console, progress
from pipeline.core.records import ImageRecord, Rejection, Split, escape_non_utf8, is_utf8
from pipeline.shards.duplicates import COLUMNS, find_duplicates
from pipeline.shards.extend import new_records, next_numbers
from pipeline.shards.manifest import (
    MANIFEST,
    Manifest,
    Shard,
    read_damaged,
    read_manifest,
    write_damaged,
)
from pipeline.shards.plan import ShardPlan, ShardSize, plan_shards
from pipeline.shards.record_table import FOLDER, Packed, part_intact, read_packed, read_part
from pipeline.shards.repair import find_damaged, repair
from pipeline.shards.settings import PackingSettings
from pipeline.shards.writer import UNREADABLE, write_shard
from pipeline.sources import name_of
from pipeline.sources.base import Source, scan_images


class TooManyRejected(Incomplete):
    """More images were refused than `max_bad_fraction` allows."""


@dataclass
class ScanResult:
    """What a source gave, and what has been refused of it so far."""

    records: list[ImageRecord]
    rejected: list[Rejection]
    found: int
    "Images before any were sorted out."
    known: int = 0
    "Images that the set held already."


@locks_output(lambda source, settings: settings.out)
def pack(source: Source, settings: PackingSettings) -> Manifest:
    """Pack a source's imagery; a finished set is left as it is, an unfinished one is gone on with.

    Raises InputError on unusable input, TooManyRejected when more than `max_bad_fraction` of the
    images are refused.
    """
    began, out, said = (
        time.monotonic(),
        storage.absolute(settings.out),
        pack_config(source, settings),
    )
    before, damaged = find_finished(settings, said)
    if before is not None and not settings.extend and not damaged:
        console.print(f"{settings.out} is complete: {len(before.shards)} shards; nothing to do")
        return before
    haul = scan(source, storage.absolute(settings.root))  # workers may stand in another folder
    if before is not None and damaged:
        repair(source, out, before, damaged, haul.records)
        console.print(f"{settings.out}: {len(damaged)} damaged shards were made anew")
        if not settings.extend:
            return before
    if before is not None:
        haul.records, refused, haul.known = new_records(haul.records, source, out, before)
        haul.rejected += refused
    size = ShardSize(
        samples_per_shard=settings.samples_per_shard,
        megabytes_per_shard=settings.megabytes_per_shard,
        numbered_from={} if before is None else next_numbers(before),
    )
    plans, refused = plan_shards(haul.records, size)
    haul.rejected += refused
    old = frozenset() if before is None else frozenset(shard.name for shard in before.shards)
    remove_stale(out, old.union(plan.name for plan in plans))
    scanned = time.monotonic()
    packed = pack_plans(plans, source, settings, said, haul)
    # Whether two images are the same is known when all have been read: the tars of the second ones
    # are written again.
    tables = (read_part(out, name, COLUMNS) for name in sorted(old.union(packed)))
    doubles = find_duplicates(tables, settled=old) if packed else {}
    again = [plan for plan in plans if plan.name in doubles]
    if again:
        packed |= pack_plans(again, source, settings, said, haul, doubles)
    haul.rejected += [rejection for done in packed.values() for rejection in done.rejected]
    check_rejections(settings, haul.rejected, haul.found)
    refusals = rejections.write_rejections(out, haul.rejected, keep=before is not None)
    full = {name: done for name, done in packed.items() if done.shard.samples}
    remove_stale(out, old.union(full))
    manifest = compose_manifest(before, said, full, haul, refusals)
    json_files.write_checksummed(storage.join(out, MANIFEST), asdict(manifest))
    write_damaged(out, ())
    log_summary(settings, full, haul, scanned - began, time.monotonic() - scanned)
    return manifest


def pack_config(source: Source, settings: PackingSettings) -> dict[str, Any]:
    """What of the settings decides what is packed."""
    flags = json.loads(json.dumps(asdict(source)))
    packing = {
        name: getattr(settings, name)
        for name in ("samples_per_shard", "megabytes_per_shard", "check")
    }
    return {"source": name_of(source), **flags, "root": storage.absolute(settings.root), **packing}


def find_finished(
    settings: PackingSettings, said: dict[str, Any]
) -> tuple[Manifest | None, list[Shard]]:
    """The manifest of the set in `out`, where there is one to be left, extended or mended, and its
    damaged shards.

    Raises InputError when it is another set than the settings ask for, or when there is nothing
    that could be extended.
    """
    out = settings.out
    if not storage.exists(storage.join(out, MANIFEST)):
        if settings.extend:
            raise InputError(
                f"{out} holds no finished set of shards; expected one to extend; pack it without --extend first"
            )
        return None, []
    manifest = read_manifest(out)
    if not settings.extend and manifest.packing != said:
        changed = ", ".join(name for name in said if manifest.packing.get(name) != said[name])
        raise InputError(
            f"{out} holds shards packed with another {changed}; choose another --out, delete it, or add to it with --extend"
        )
    damaged = find_damaged(out, manifest)
    if (
        settings.extend
        or manifest.added
        or (not damaged and rejections.rejections_intact(out, manifest.rejected))
    ):
        return manifest, damaged
    wrong = f"{len(damaged)} shards are" if damaged else f"{rejections.REJECTED_FILE} is"
    console.print(f"{out}: {wrong} missing or damaged; what is not whole is packed again")
    return None, []


def scan(source: Source, root: str) -> ScanResult:
    """All that a source finds; what has a name that cannot be written down is refused here."""
    records: list[ImageRecord] = []
    rejected: list[Rejection] = []
    for found in scan_images(source, root):
        name = found.path if isinstance(found, Rejection) else f"{found.name}{found.location}"
        if not is_utf8(name):
            told = escape_non_utf8(found.path)
            rejected.append(
                Rejection(path=told, reason="name is not UTF-8", found=told.rsplit("/", 1)[-1])
            )
        elif isinstance(found, Rejection):
            rejected.append(found)
        else:
            records.append(found)
    return ScanResult(records=records, rejected=rejected, found=len(records) + len(rejected))


def remove_stale(out: str, wanted: frozenset[str]) -> None:
    """Take away our other tars, known by their record parts: empty ones, and those that other
    settings left.
    """
    for name in storage.list_names(storage.join(out, FOLDER)):
        stem = name.removesuffix(".parquet")
        if stem not in wanted:
            tar = storage.join(out, f"{stem}.tar")
            if storage.exists(tar):
                storage.remove(tar)
            storage.remove(storage.join(out, FOLDER, name))


def pack_plans(
    plans: Sequence[ShardPlan],
    source: Source,
    settings: PackingSettings,
    said: dict[str, Any],
    haul: ScanResult,
    doubles: Mapping[str, dict[str, str]] | None = None,
) -> dict[str, Packed]:
    """Each plan's tar, by name: as it is there already, or else packed now. With `doubles`, without
    these and in any case.

    Raises TooManyRejected as soon as that is certain.
    """
    out, packed = storage.absolute(settings.out), {}
    digests = {plan.name: plan.digest(said) for plan in plans}
    if doubles is None:
        sizes = storage.walk(out) if storage.is_folder(out) else {}
        for name in read_damaged(out):
            sizes.pop(f"{name}.tar", None)
        packed = {
            name: done
            for name in digests
            if (done := load_if_done(out, name, digests[name], sizes)) is not None
        }
        if packed:
            console.print(f"{len(packed)} of {len(plans)} shards are there already")
    todo = [plan for plan in plans if plan.name not in packed]
    refused, megabytes, began = list(haul.rejected), 0.0, time.monotonic()
    with progress(sum(len(plan.records) for plan in todo), "packing") as meter:
        arguments = (
            (plan, source, out, digests[plan.name], settings.check, (doubles or {}).get(plan.name))
            for plan in todo
        )
        # Starting Ray takes longer than one tar.
        workers = 0 if settings.workers is None and len(todo) <= 1 else settings.workers
        for done in write_shards(arguments, workers):
            packed[done.shard.name] = done
            refused += done.rejected
            megabytes += done.shard.bytes / 1e6
            rate = f"{megabytes / (time.monotonic() - began):.1f}"
            meter.advance(
                done.shard.samples + len(done.rejected),
                refused=len(refused),
                megabytes_per_second=rate,
            )
            check_rejections(settings, refused, haul.found)
    return packed


def load_if_done(out: str, name: str, digest: str, sizes: Mapping[str, int]) -> Packed | None:
    """What became of this very plan, where it is done; images that could not be read get another
    chance.
    """
    done = read_packed(out, name) if f"{FOLDER}/{name}.parquet" in sizes else None
    if done is None or done.plan != digest or sizes.get(f"{name}.tar") != done.shard.bytes:
        return None
    if any(rejection.reason == UNREADABLE for rejection in done.rejected):
        return None
    return done if part_intact(out, name) else None


def write_shards(arguments: Iterable[tuple[Any, ...]], workers: int | None) -> Iterator[Packed]:
    """`write_shard` for all arguments, as they are done."""
    if workers == 0:
        yield from (write_shard(*given) for given in arguments)
        return
    cluster.connect()
    task = ray.remote(num_cpus=1)(write_shard)
    window = workers or 2 * cluster.cpus()
    yield from (
        done
        for _, done in cluster.bounded_map(lambda given: task.remote(*given), arguments, window)
    )


def check_rejections(settings: PackingSettings, refused: Sequence[Rejection], found: int) -> None:
    """Raise TooManyRejected, with the list written, if that many were refused. A known image is no
    bad one when extending.
    """
    bad = [one for one in refused if not (settings.extend and one.reason == "duplicate")]
    if len(bad) <= settings.max_bad_fraction * found:
        return
    rejections.write_rejections(settings.out, refused, keep=settings.extend)
    raise TooManyRejected(
        f"{len(bad)} of {found} images were refused, more than {settings.max_bad_fraction:.2%}: {rejections.most_common_reasons(bad)}; see "
        f"{storage.join(settings.out, rejections.REJECTED_FILE)}, mend them or raise --max-bad-fraction"
    )


def compose_manifest(
    before: Manifest | None,
    said: dict[str, Any],
    packed: Mapping[str, Packed],
    haul: ScanResult,
    refusals: int,
) -> Manifest:
    """The set as it is now. Classes that were there keep their numbers."""
    shards = tuple(packed[name].shard for name in sorted(packed))
    trained = {record.location for record in haul.records if record.split == Split.TRAIN}
    if before is None:
        return Manifest(
            shards=shards, classes=tuple(sorted(trained)), packing=said, rejected=refusals
        )
    return replace(
        before,
        shards=before.shards + shards,
        classes=before.classes + tuple(sorted(trained.difference(before.classes))),
        added=(*before.added, said) if packed else before.added,
        rejected=refusals,
    )


def log_summary(
    settings: PackingSettings,
    packed: Mapping[str, Packed],
    haul: ScanResult,
    scanning: float,
    packing: float,
) -> None:
    """Where the shards are, what is in them, how the time was spent."""
    images, size = (
        sum(getattr(done.shard, name) for done in packed.values()) for name in ("samples", "bytes")
    )
    refused = f"{len(haul.rejected)} refused"
    if haul.rejected:
        refused += (
            f" ({rejections.most_common_reasons(haul.rejected)}; see {rejections.REJECTED_FILE})"
        )
    known = f"; {haul.known} were there already" if settings.extend else ""
    console.print(
        f"{settings.out}: {len(packed)} {'new ' if settings.extend else ''}shards, {images} images, {size / 1e6:.1f} MB, "
        f"{refused}{known}; scanned in {scanning:.1f} s, packed in {packing:.1f} s",
    )
