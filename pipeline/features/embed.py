"""Shards + encoder -> feature table: the stage. Ray actors make one Parquet part per shard; done
parts are left as they are.

In: a set of shards, and the encoder as a factory that is called on each worker. Out: the table, the
list of what of the shards has no row, and a summary. However often workers or the stage itself are
killed, the table ends up with the same bytes: a part is a function of its shard, and appears whole.
"""

import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

import ray

from pipeline.core import cluster, storage
from pipeline.core import rejections as rejects
from pipeline.core.actor_pool import ActorPool, NoWorkerStarted, PoolConfig, PoolFailed, Skipped
from pipeline.core.cluster import Node, Placement, plan_placement
from pipeline.core.errors import Incomplete, InputError
from pipeline.core.lock import locks_output
from pipeline.core.progress import console, progress
from pipeline.features import expected_parts
from pipeline.features.embed_worker import (
    IN_FLIGHT,
    EmbedJob,
    Encoder,
    EncoderSpec,
    ShardEmbedder,
    ShardResult,
    TableWriteFailed,
)
from pipeline.features.part import (
    REJECTED,
    PartHeader,
    part_names,
    read_header,
    read_headers,
    verify_part,
    write_rejected,
)
from pipeline.features.settings import EmbeddingSettings
from pipeline.shards.manifest import Shard
from pipeline.shards.shard_set import ShardSet, open_or_scan
from pipeline.shards.verify import require_intact

__all__ = ["EmbeddingSettings", "Encoder", "EncoderSpec", "IncompleteEmbedding", "embed_gallery"]


class IncompleteEmbedding(Incomplete):
    """Embedding has done what it could, and some shards could not be done. One sentence, with their
    names.
    """


@locks_output(lambda settings, network: settings.out)
def embed_gallery(settings: EmbeddingSettings, network: EncoderSpec) -> int:
    """Embed every shard that has no finished part yet; returns how many images were embedded.

    `settings` must name paths that a worker can open (absolute, or URIs). Raises InputError on unusable input, Incomplete
    where shards are unreadable or kill their workers, the others being done.
    """
    shards = open_or_scan(settings.shards, settings.split, settings.view)
    if settings.verify and not shards.external:
        require_intact(shards)
    wanted = requested_shards(settings, shards)
    missing = pending_shards(settings, network, wanted)
    expected_parts.add_expected(settings.out, [f"{shard.name}.parquet" for shard in wanted])
    absent = shards.missing_tars(missing)  # said now, and not when their turn comes
    lost = {
        name: Skipped(reason="unusable", found=f"{said}; {shards.repair_hint}")
        for name, said in absent.items()
    }
    embedded = 0
    for name, aside in lost.items():
        console.print(f"{name} is set aside ({aside.reason}): {aside.found}", style="yellow")
    if todo := [shard for shard in missing if shard.name not in lost]:
        cluster.connect()
        nodes = cluster.nodes()
        given = (settings.workers, settings.cpus_per_worker, settings.gpus_per_worker)
        placement = plan_placement(nodes, len(todo), *given)
        crew = ActorPool(pool_config(settings, shards, network, placement, nodes))
        embedded, given_up = run_pool(settings, crew, todo, placement)
        lost |= given_up
    expected_parts.remove_expected(settings.out, [f"{name}.parquet" for name in lost])
    storage.remove_temporaries(
        settings.out,
        [expected_parts.EXPECTED_PARTS, *(f"{shard.name}.parquet" for shard in wanted)],
    )
    rejections = [
        (header.name.removesuffix(".parquet"), one)
        for header in read_headers(settings.out)
        for one in header.footer.rejected
    ]
    listed = write_rejected(
        settings.out,
        [
            *((name, one.path, one.reason, one.found) for name, one in rejections),
            *((name, None, aside.reason, aside.found) for name, aside in lost.items()),
        ],
    )
    if listed and rejections:
        reasons = rejects.most_common_reasons(one for _, one in rejections)
        told = f"{len(rejections)} images could not be decoded: {reasons}; see {storage.join(settings.out, REJECTED)}"
        console.print(told, style="yellow")
    if lost:
        reasons = "; ".join(
            f"{name} ({aside.reason}: {aside.found})" for name, aside in sorted(lost.items())
        )
        raise IncompleteEmbedding(
            f"{len(lost)} of {len(wanted)} shards could not be embedded, expected all; the others are done; mend these and run "
            f"the same command again: {reasons}"
        )
    if not missing:
        console.print(f"{settings.out} is complete: {len(wanted)} parts; nothing to do")
    return embedded


def requested_shards(settings: EmbeddingSettings, shards: ShardSet) -> list[Shard]:
    """The shards that were asked for.

    Raises InputError when there are none.
    """
    manifest = shards.manifest
    wanted = [shard for shard in manifest.of(settings.split, settings.view) if shard.samples]
    if not wanted:
        held = (
            ", ".join(sorted({f"{shard.split} {shard.view}" for shard in manifest.shards}))
            or "nothing"
        )
        raise InputError(
            f"{settings.shards} holds {held}, and none of it was asked for; check --split and --view"
        )
    return wanted


def pending_shards(
    settings: EmbeddingSettings, network: EncoderSpec, wanted: Sequence[Shard]
) -> list[Shard]:
    """Those that have no finished part: one that is there, complete, and made of this very shard.

    Raises InputError when the table holds another network's parts, or another kind of numbers.
    """
    own = {f"{shard.name}.parquet": shard for shard in wanted}
    done = set()
    for name in part_names(settings.out):
        try:
            header = read_header(storage.join(settings.out, name))
            if settings.verify:
                verify_part(storage.join(settings.out, name))
        except InputError as error:
            if name not in own:
                raise
            console.print(f"{error}; it is embedded again", style="yellow")
            continue
        check_same_encoder(settings, network, header)
        footer, shard = header.footer, own.get(name)
        counted = footer.rows + len(footer.rejected)
        if shard and (footer.shard_sha256, counted) == (shard.sha256, shard.samples):
            done.add(shard.name)
    return [shard for shard in wanted if shard.name not in done]


def check_same_encoder(
    settings: EmbeddingSettings, network: EncoderSpec, header: PartHeader
) -> None:
    """Raise InputError where a part of the table cannot stand beside those that would be made."""
    path, made_by = storage.join(settings.out, header.name), header.footer.fingerprint
    if made_by != network.fingerprint:
        raise InputError(
            f"{path} was made by network {made_by[:12]}, this checkpoint is {network.fingerprint[:12]}; choose another "
            "--out, the --precision, --resizer and --mirror that it was made with, or delete the old table"
        )
    if header.dtype != settings.dtype:
        raise InputError(
            f"{path} holds {header.dtype}, --dtype is {settings.dtype}, expected one kind of numbers in a table; choose "
            f"another --out, or --dtype {header.dtype}"
        )


def pool_config(
    settings: EmbeddingSettings,
    shards: ShardSet,
    network: EncoderSpec,
    placement: Placement,
    nodes: Sequence[Node],
) -> PoolConfig:
    """How the crew works: what an actor is, and which failures are whose."""
    cpus, gpus = placement.cpus, placement.gpus
    assignment = EmbedJob(
        shards=shards.for_workers(),
        out=settings.out,
        batch_size=settings.batch_size,
        dtype=settings.dtype,
        threads=cpus,
        decode_threads=settings.decode_threads or max(1, cpus - 1 if gpus else cpus // 4),
    )
    actor: Any = ray.remote(num_cpus=cpus, num_gpus=gpus)(ShardEmbedder).options(
        max_concurrency=IN_FLIGHT
    )
    shared = ray.put(network)  # the weights travel to each node once
    return PoolConfig(
        create_actor=lambda: actor.remote(assignment, shared),
        size=placement.workers,
        resources=f"{placement}, and the largest of {len(nodes)} nodes has {max((n.cpus for n in nodes), default=0):g} CPUs",
        in_flight=IN_FLIGHT,
        skip_on=(InputError,),
        fatal=(TableWriteFailed,),
        patience=settings.patience,
        notify=console.print,
    )


def run_pool(
    settings: EmbeddingSettings, crew: ActorPool, missing: Sequence[Shard], placement: Placement
) -> tuple[int, dict[str, Skipped]]:
    """Embed the missing shards; returns how many images that made, and which shards had to be set
    aside.
    """
    spent, embedded, lost, start = Counter[str](), 0, dict[str, Skipped](), time.monotonic()
    try:
        with progress(sum(shard.samples for shard in missing), "embedding") as meter:
            for shard, result in crew.work(missing):
                if isinstance(result, Skipped):
                    lost[shard.name] = result
                    meter.note(f"{shard.name} is set aside ({result.reason}): {result.found}")
                    continue
                assert isinstance(result, ShardResult)
                spent.update(result.seconds)
                embedded += shard.samples
                meter.advance(shard.samples, workers=crew.ready_workers)
    except NoWorkerStarted as error:
        raise InputError(
            f"{error}; start nodes that have them, or give --cpus-per-worker, --gpus-per-worker"
        ) from None
    except (PoolFailed, TableWriteFailed) as error:
        raise IncompleteEmbedding(str(error)) from error
    elapsed = time.monotonic() - start
    idle = max(0.0, crew.seconds - spent["infer"])
    threads = ", ".join(f"{name} {spent[name]:.1f} s" for name in ("read", "decode", "write"))
    console.print(
        f"{settings.out}: {embedded} images in {elapsed:.1f} s; over {placement.workers} workers of {placement}: infer "
        f"{spent['infer']:.1f} s, idle {idle:.1f} s, beside it {threads}"
    )
    return embedded, lost
