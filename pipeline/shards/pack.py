"""Imagery -> shards: the stage. A killed packing resumes, a finished set is left alone, extended or
repaired.

In: a source and a root. Out: tars, their record table, `rejected.parquet`, and last of all
`manifest.json`. The same input gives the same bytes whatever the parallelism, and however often
packing was killed and resumed.
"""

import json
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

from pipeline.core import json_files, rejections, storage
from pipeline.core.errors import InputError
from pipeline.core.lock import locks_output
from pipeline.core.progress import console
from pipeline.core.records import ImageRecord, Rejection, Split, escape_non_utf8, is_utf8
from pipeline.shards.duplicates import COLUMNS, find_duplicates, new_records
from pipeline.shards.manifest import MANIFEST, Manifest, Shard, write_damaged
from pipeline.shards.pack_tars import ScanResult, check_rejections, pack_plans
from pipeline.shards.plan import ShardSize, next_numbers, plan_shards
from pipeline.shards.record_table import FOLDER, Packed, read_part
from pipeline.shards.repair import find_damaged, repair
from pipeline.shards.settings import PackingSettings
from pipeline.shards.shard_set import ShardSet, open_shards
from pipeline.sources import name_of
from pipeline.sources.base import Source, scan_images


@locks_output(lambda source, settings: settings.out)
def pack(source: Source, settings: PackingSettings) -> Manifest:
    """Pack a source's imagery; a finished set is left as it is, an unfinished one is resumed.

    Raises InputError on unusable input, TooManyRejected when more than `max_bad_fraction` of the
    images are refused.
    """
    began, out, config = (
        time.monotonic(),
        storage.absolute(settings.out),
        pack_config(source, settings),
    )
    before, damaged = find_finished(settings, config)
    if before is not None and not settings.extend and not damaged:
        count = len(before.manifest.shards)
        console.print(f"{settings.out} is complete: {count} shards; nothing to do")
        return before.manifest
    scanned = scan(source, storage.absolute(settings.root))  # workers may stand in another folder
    if before is not None and damaged:
        repair(source, before, damaged, scanned.records)
        console.print(f"{settings.out}: {len(damaged)} damaged shards were repaired")
        if not settings.extend:
            return before.manifest
    if before is not None:
        scanned.records, refused, scanned.known = new_records(scanned.records, source, before)
        scanned.rejected += refused
    size = ShardSize(
        samples_per_shard=settings.samples_per_shard,
        megabytes_per_shard=settings.megabytes_per_shard,
        numbered_from={} if before is None else next_numbers(before.manifest),
    )
    plans, refused = plan_shards(scanned.records, size)
    scanned.rejected += refused
    old = frozenset[str]()
    if before is not None:
        old = frozenset(shard.name for shard in before.manifest.shards)
    remove_stale(out, old.union(plan.name for plan in plans))
    planned = time.monotonic()
    packed = pack_plans(plans, source, settings, config, scanned)
    # Duplicates are known only when all images have been read; tars that hold one are packed again
    # without it.
    tables = (read_part(out, name, COLUMNS) for name in sorted(old.union(packed)))
    duplicates = find_duplicates(tables, settled=old) if packed else {}
    if again := [plan for plan in plans if plan.name in duplicates]:
        packed |= pack_plans(again, source, settings, config, scanned, duplicates)
    scanned.rejected += [rejection for done in packed.values() for rejection in done.rejected]
    check_rejections(settings, scanned.rejected, scanned.found)
    refusals = rejections.write_rejections(out, scanned.rejected, keep=before is not None)
    full = {name: done for name, done in packed.items() if done.shard.samples}
    remove_stale(out, old.union(full))
    earlier = None if before is None else before.manifest
    manifest = compose_manifest(earlier, config, full, scanned, refusals)
    json_files.write_checksummed(storage.join(out, MANIFEST), asdict(manifest))
    write_damaged(out, ())
    log_summary(settings, full, scanned, planned - began, time.monotonic() - planned)
    return manifest


def pack_config(source: Source, settings: PackingSettings) -> dict[str, Any]:
    """The settings that determine a shard's content; compared on resume."""
    flags = json.loads(json.dumps(asdict(source)))
    packing = {
        name: getattr(settings, name)
        for name in ("samples_per_shard", "megabytes_per_shard", "check")
    }
    return {"source": name_of(source), **flags, "root": storage.absolute(settings.root), **packing}


def find_finished(
    settings: PackingSettings, config: dict[str, Any]
) -> tuple[ShardSet | None, list[Shard]]:
    """The set in `out`, where there is one to be left alone, extended or repaired, and its damaged
    shards.

    Raises InputError when it was packed with other settings, or when there is none to extend.
    """
    out = storage.absolute(settings.out)
    if not storage.exists(storage.join(out, MANIFEST)):
        if settings.extend:
            raise InputError(
                f"{settings.out} holds no finished set of shards; expected one to extend; pack it "
                "without --extend first"
            )
        return None, []
    shards = open_shards(out)
    manifest = shards.manifest
    if not settings.extend and manifest.packing != config:
        changed = ", ".join(name for name in config if manifest.packing.get(name) != config[name])
        raise InputError(
            f"{settings.out} holds shards packed with another {changed}; choose another --out, "
            "delete it, or add to it with --extend"
        )
    damaged = find_damaged(shards)
    intact = not damaged and rejections.rejections_intact(out, manifest.rejected)
    if settings.extend or manifest.added or intact:
        return shards, damaged
    wrong = f"{len(damaged)} shards are" if damaged else f"{rejections.REJECTED_FILE} is"
    console.print(f"{settings.out}: {wrong} missing or damaged and will be packed again")
    return None, []


def scan(source: Source, root: str) -> ScanResult:
    """Everything that a source finds; files whose names are not UTF-8 are refused."""
    records: list[ImageRecord] = []
    rejected: list[Rejection] = []
    for found in scan_images(source, root):
        name = found.path if isinstance(found, Rejection) else f"{found.name}{found.location}"
        if not is_utf8(name):
            path = escape_non_utf8(found.path)
            file = path.rsplit("/", 1)[-1]
            rejected.append(Rejection(path=path, reason="name is not UTF-8", found=file))
        elif isinstance(found, Rejection):
            rejected.append(found)
        else:
            records.append(found)
    return ScanResult(records=records, rejected=rejected, found=len(records) + len(rejected))


def remove_stale(out: str, wanted: frozenset[str]) -> None:
    """Remove all other tars that packing wrote, known by their record parts: empty ones, and those
    of other settings.
    """
    for name in storage.list_names(storage.join(out, FOLDER)):
        stem = name.removesuffix(".parquet")
        if stem not in wanted:
            tar = storage.join(out, f"{stem}.tar")
            if storage.exists(tar):
                storage.remove(tar)
            storage.remove(storage.join(out, FOLDER, name))


def compose_manifest(
    before: Manifest | None,
    config: dict[str, Any],
    packed: Mapping[str, Packed],
    scanned: ScanResult,
    refusals: int,
) -> Manifest:
    """The manifest of the set as it is now. Classes of the earlier manifest keep their numbers."""
    shards = tuple(packed[name].shard for name in sorted(packed))
    trained = {record.location for record in scanned.records if record.split == Split.TRAIN}
    if before is None:
        classes = tuple(sorted(trained))
        return Manifest(shards=shards, classes=classes, packing=config, rejected=refusals)
    return replace(
        before,
        shards=before.shards + shards,
        classes=before.classes + tuple(sorted(trained.difference(before.classes))),
        added=(*before.added, config) if packed else before.added,
        rejected=refusals,
    )


def log_summary(
    settings: PackingSettings,
    packed: Mapping[str, Packed],
    scanned: ScanResult,
    scan_s: float,
    pack_s: float,
) -> None:
    """Print where the shards are, their content, and how the time was spent."""
    images = sum(done.shard.samples for done in packed.values())
    megabytes = sum(done.shard.bytes for done in packed.values()) / 1e6
    refused = f"{len(scanned.rejected)} refused"
    if scanned.rejected:
        reasons = rejections.most_common_reasons(scanned.rejected)
        refused += f" ({reasons}; see {rejections.REJECTED_FILE})"
    new, known = (
        ("new ", f"; {scanned.known} were in the set already") if settings.extend else ("", "")
    )
    console.print(
        f"{settings.out}: {len(packed)} {new}shards, {images} images, {megabytes:.1f} MB, "
        f"{refused}{known}; scanned in {scan_s:.1f} s, packed in {pack_s:.1f} s"
    )
