"""A finished set of shards with damaged tars or record parts: which they are, and how they are made
anew, to the same bytes.

In: a set, its manifest, imagery as a source found it. Out: the tars whose images the source has,
written again and held against the manifest's hashes before they take the damaged ones' places. So a
set that was extended is mended as well: by each of the commands that packed it, its own images.
"""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pipeline.core import rejections, storage
from pipeline.core.errors import InputError
from pipeline.core.records import ImageRecord
from pipeline.shards.manifest import Manifest, Shard, missing_tars, read_damaged, write_damaged
from pipeline.shards.plan import ShardPlan
from pipeline.shards.record_table import FOLDER, read_packed, read_part
from pipeline.shards.writer import write_shard
from pipeline.sources.base import Source

SCRATCH = "_mending"


def find_damaged(out: str, manifest: Manifest) -> list[Shard]:
    """Shards whose tar or record part is not there, has another size, or was found damaged by
    verification.
    """
    wrong = read_damaged(out).union(missing_tars(out, manifest.shards))
    parts = set(storage.list_names(storage.join(out, FOLDER)))
    return [
        shard
        for shard in manifest.shards
        if shard.name in wrong or f"{shard.name}.parquet" not in parts
    ]


def repair(
    source: Source,
    out: str,
    manifest: Manifest,
    damaged: Sequence[Shard],
    records: Iterable[ImageRecord],
) -> None:
    """Make the damaged shards anew whose images are among the records. The others' note stays.

    Raises InputError where some are left, with the commands that packed the set.
    """
    left: list[Shard] = []
    for plan, shard in _plans(out, manifest, damaged, records):
        if plan is None or not _write(source, out, shard, plan):
            left.append(shard)
    storage.remove_folder(storage.join(out, SCRATCH))
    write_damaged(out, [shard.name for shard in left])
    if left:
        raise InputError(
            f"{len(left)} shards of {out} are damaged, {left[0].name} first, and this imagery does not hold what they were "
            f"packed from; expected that of {packing_commands(manifest)}; run these again as they were run, or put the tars and their "
            "record parts back from a copy"
        )


def packing_commands(manifest: Manifest) -> str:
    """The calls that packed a set, as far as a manifest says."""
    packed: Sequence[Mapping[str, Any]] = (manifest.packing, *manifest.added)
    said = [
        f"jobs/make_shards.py --source {one.get('source')} --root {one.get('root')}"
        for one in packed
    ]
    return ", then ".join([said[0], *(f"{one} --extend" for one in said[1:])])


def _plans(
    out: str, manifest: Manifest, damaged: Sequence[Shard], records: Iterable[ImageRecord]
) -> list[tuple[ShardPlan | None, Shard]]:
    """What each damaged shard held, in its order; None where these records are not it.

    By the shard's record part; where that is lost, by what no other shard of its split and view
    holds, in the order that packing has. The hash decides in the end.
    """
    held = {record.key: record for record in records}
    keys = {shard.name: _keys(out, shard) for shard in manifest.shards}
    known = {key for each in keys.values() for key in each or ()}
    refused = rejections.rejected_paths(out)
    lost = sorted(
        (key for key, record in held.items() if key not in known and record.name not in refused),
        key=lambda key: hashlib.sha256(key.encode()).hexdigest(),
    )
    plans: list[tuple[ShardPlan | None, Shard]] = []
    for shard in sorted(damaged, key=lambda one: one.name):
        wanted = keys[shard.name]
        if wanted is None:
            alike = [
                key
                for key in lost
                if (held[key].split, held[key].view) == (shard.split, shard.view)
            ]
            wanted = alike[: shard.samples]
            lost = [key for key in lost if key not in set(wanted)]
        found = tuple(held[key] for key in wanted if key in held)
        plan = ShardPlan(name=shard.name, split=shard.split, view=shard.view, records=found)
        plans.append((plan if len(found) == shard.samples else None, shard))
    return plans


def _keys(out: str, shard: Shard) -> list[str] | None:
    """The keys of a shard's images in their order, by its record part; None where it cannot say."""
    try:
        keys: list[str] = read_part(out, shard.name, ["key"])["key"].to_pylist()
    except InputError:
        return None
    return keys if len(keys) == shard.samples else None


def _write(source: Source, out: str, shard: Shard, plan: ShardPlan) -> bool:
    """Write a shard anew; whether it is what the manifest says. Else nothing has changed."""
    before, scratch = read_packed(out, shard.name), storage.join(out, SCRATCH)
    packed = write_shard(plan, source, scratch, "" if before is None else before.plan)
    if packed.shard != shard:
        return False
    for name in (f"{shard.name}.tar", f"{FOLDER}/{shard.name}.parquet"):
        storage.link_or_copy(storage.join(scratch, name), storage.join(out, name))
    return True
