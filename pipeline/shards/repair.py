"""Repair of a finished set of shards: damaged tars and record parts are found, and packed again to
the same bytes.

In: a ShardSet and the imagery that a source found. Out: the damaged tars whose images the source
has, packed again and compared with the manifest's hashes before they replace the damaged ones.
Extended sets can be repaired too: rerun each packing command; it repairs the shards it wrote.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pipeline.core import rejections, storage
from pipeline.core.errors import InputError
from pipeline.core.integrity import sha256_of
from pipeline.core.records import ImageRecord
from pipeline.shards.manifest import Manifest, Shard, read_damaged, write_damaged
from pipeline.shards.plan import ShardPlan
from pipeline.shards.record_table import FOLDER, read_packed
from pipeline.shards.shard_set import ShardSet
from pipeline.shards.writer import write_shard
from pipeline.sources.base import Source

SCRATCH = "_repair"


def find_damaged(shards: ShardSet) -> list[Shard]:
    """Shards whose tar or record part is absent, has another size, or was found damaged by
    verification.
    """
    listed = shards.manifest.shards
    wrong = read_damaged(shards.path).union(shards.missing_tars(listed))
    parts = set(storage.list_names(storage.join(shards.path, FOLDER)))
    return [
        shard for shard in listed if shard.name in wrong or f"{shard.name}.parquet" not in parts
    ]


def repair(
    source: Source, shards: ShardSet, damaged: Sequence[Shard], records: Iterable[ImageRecord]
) -> None:
    """Pack the damaged shards again whose images are among the records. The others stay listed.

    Raises InputError where some are left, with the commands that packed the set.
    """
    left: list[Shard] = []
    for shard, plan in _plan_repairs(shards, damaged, records):
        if plan is None or not _replace(source, shards.path, shard, plan):
            left.append(shard)
    storage.remove_folder(storage.join(shards.path, SCRATCH))
    write_damaged(shards.path, [shard.name for shard in left])
    if left:
        raise InputError(
            f"{len(left)} shards of {shards.path} are damaged, {left[0].name} first, and this "
            "imagery does not hold what they were packed from; expected that of "
            f"{packing_commands(shards.manifest)}; run these again as they were run, or put the "
            "tars and their record parts back from a copy"
        )


def packing_commands(manifest: Manifest) -> str:
    """The commands that packed a set, as far as a manifest records them."""
    packed: Sequence[Mapping[str, Any]] = (manifest.packing, *manifest.added)
    commands = [
        f"jobs/make_shards.py --source {settings.get('source')} --root {settings.get('root')}"
        for settings in packed
    ]
    return ", then ".join([commands[0], *(f"{command} --extend" for command in commands[1:])])


def _plan_repairs(
    shards: ShardSet, damaged: Sequence[Shard], records: Iterable[ImageRecord]
) -> list[tuple[Shard, ShardPlan | None]]:
    """Each damaged shard with the plan of its images in their order; None where these records do
    not have them.

    By the shard's record part; where that is lost, by the records of its split and view that no
    other shard holds, in the order that packing has. The hash decides in the end.
    """
    by_key = {record.key: record for record in records}
    keys = {shard.name: _keys(shards, shard) for shard in shards.manifest.shards}
    known = {key for each in keys.values() for key in each or ()}
    refused = rejections.rejected_paths(shards.path)
    unassigned = sorted(
        (key for key, record in by_key.items() if key not in known and record.name not in refused),
        key=lambda key: sha256_of(key.encode()),
    )
    plans: list[tuple[Shard, ShardPlan | None]] = []
    for shard in sorted(damaged, key=lambda shard: shard.name):
        wanted = keys[shard.name]
        if wanted is None:
            kind = shard.split, shard.view
            alike = [key for key in unassigned if (by_key[key].split, by_key[key].view) == kind]
            wanted = alike[: shard.samples]
            unassigned = [key for key in unassigned if key not in set(wanted)]
        found = tuple(by_key[key] for key in wanted if key in by_key)
        plan = ShardPlan(name=shard.name, split=shard.split, view=shard.view, records=found)
        plans.append((shard, plan if len(found) == shard.samples else None))
    return plans


def _keys(shards: ShardSet, shard: Shard) -> list[str] | None:
    """The keys of a shard's images in their order, by its record part; None where it is damaged."""
    try:
        keys: list[str] = shards.records(shard, ["key"])["key"].to_pylist()
    except InputError:
        return None
    return keys if len(keys) == shard.samples else None


def _replace(source: Source, out: str, shard: Shard, plan: ShardPlan) -> bool:
    """Pack a shard again and replace it where the result is what the manifest says; returns whether
    it is.
    """
    before, scratch = read_packed(out, shard.name), storage.join(out, SCRATCH)
    packed = write_shard(plan, source, scratch, "" if before is None else before.plan)
    if packed.shard != shard:
        return False
    for name in (f"{shard.name}.tar", f"{FOLDER}/{shard.name}.parquet"):
        storage.link_or_copy(storage.join(scratch, name), storage.join(out, name))
    return True
