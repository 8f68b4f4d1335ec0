"""Shards + encoder -> feature table: the stage, in three steps: plan, run, report.

In: a set of shards, and the encoder as a factory that is called on each worker. Out: the table, the
list of the images and shards that have no row, and a summary. Ray actors, or this process, write
one part per shard; a rerun skips finished parts. However often workers or the stage itself are
killed, the table ends up with the same bytes: a part is a function of its shard and appears
atomically.
"""

import os
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import ray

from pipeline.core import cluster
from pipeline.core.actor_pool import ActorPool, NoWorkerStarted, PoolConfig, PoolFailed, Skipped
from pipeline.core.cluster import Node, Placement, plan_placement
from pipeline.core.errors import Incomplete, InputError
from pipeline.core.lock import locks_output
from pipeline.core.progress import console, progress
from pipeline.core.rejections import most_common_reasons
from pipeline.features.embed_worker import (
    IN_FLIGHT,
    EmbedJob,
    EncoderSpec,
    ShardEmbedder,
    ShardResult,
    TableWriteFailed,
)
from pipeline.features.rejected import rejected_file
from pipeline.features.settings import EmbeddingSettings
from pipeline.features.table_writer import ExpectedPart, FeatureTableWriter, WrittenTable
from pipeline.shards.manifest import Shard
from pipeline.shards.shard_set import ShardSet, open_or_scan
from pipeline.shards.verify import require_intact


@dataclass(frozen=True, kw_only=True)
class EmbeddingPlan:
    """What there is to do."""

    shard_set: ShardSet
    shards: tuple[Shard, ...]
    "All that were requested."
    pending: tuple[Shard, ...]
    "Those of them without a finished part."
    skipped: dict[str, Skipped]
    "Names of pending shards whose tars are missing."


@dataclass(kw_only=True)
class EmbeddingRun:
    """What a run of the workers did."""

    images: int = 0
    skipped: dict[str, Skipped] = field(default_factory=dict)
    "Names of shards that could not be embedded."
    seconds: Counter[str] = field(default_factory=Counter)
    "Of threads, by what they did: read, decode, infer, write."


@locks_output(lambda settings, encoder, shard_set=None: settings.out)
def embed_gallery(
    settings: EmbeddingSettings, encoder: EncoderSpec, shard_set: ShardSet | None = None
) -> int:
    """Embed every shard that has no finished part yet; returns how many images were embedded.

    `shard_set`: the set of the settings, where it is open already.
    `settings` must name paths that a worker can open (absolute, or URIs). Raises InputError on
    unusable input, Incomplete where shards are unreadable or kill their workers; the others are
    done then.
    """
    writer = FeatureTableWriter(settings.out, encoder.fingerprint, settings.dtype)
    plan = plan_embedding(settings, writer, shard_set)
    run = run_workers(settings, encoder, plan)
    for name, skipped in run.skipped.items():
        writer.skip(part_name(name), skipped.reason, skipped.found)
    report(settings, plan, run, writer.finish())
    return run.images


def part_name(shard: str) -> str:
    """The file name of the part that is made of a shard."""
    return f"{shard}.parquet"


def plan_embedding(
    settings: EmbeddingSettings, writer: FeatureTableWriter, shard_set: ShardSet | None = None
) -> EmbeddingPlan:
    """Find the shards that have no finished part.

    Raises InputError when none was requested, or the table is another encoder's.
    """
    shard_set = shard_set or open_or_scan(settings.shards, settings.split, settings.view)
    if settings.verify and not shard_set.external:
        require_intact(shard_set)
    shards = requested_shards(settings, shard_set)
    pending_parts = set(
        writer.expect(
            [
                ExpectedPart(
                    name=part_name(shard.name), shard_sha256=shard.sha256, images=shard.samples
                )
                for shard in shards
            ],
            settings.verify,
        )
    )
    pending = tuple(shard for shard in shards if part_name(shard.name) in pending_parts)
    # Reported now, and not hours later when their turn comes.
    skipped = {
        name: Skipped(reason="unusable", found=f"{found}; {shard_set.repair_hint}")
        for name, found in shard_set.missing_tars(pending).items()
    }
    for name, one in skipped.items():
        console.print(f"{name} is skipped ({one.reason}): {one.found}", style="yellow")
    return EmbeddingPlan(
        shard_set=shard_set, shards=tuple(shards), pending=pending, skipped=skipped
    )


def requested_shards(settings: EmbeddingSettings, shard_set: ShardSet) -> list[Shard]:
    """The shards of the requested split and view that have images.

    Raises InputError when there are none.
    """
    manifest = shard_set.manifest
    shards = [shard for shard in manifest.of(settings.split, settings.view) if shard.samples]
    if not shards:
        kinds = sorted({f"{shard.split} {shard.view}" for shard in manifest.shards})
        raise InputError(
            f"{settings.shards} holds {', '.join(kinds) or 'nothing'}, and none of it was asked "
            "for; check --split and --view"
        )
    return shards


def run_workers(
    settings: EmbeddingSettings, encoder: EncoderSpec, plan: EmbeddingPlan
) -> EmbeddingRun:
    """Embed the pending shards, on an actor pool or in this process. Raises InputError,
    Incomplete."""
    run = EmbeddingRun(skipped=dict(plan.skipped))
    shards = [shard for shard in plan.pending if shard.name not in plan.skipped]
    if not shards:
        return run
    pool: ActorPool | _ThisProcess
    if settings.workers == 0:
        job = embed_job(settings, plan.shard_set, settings.cpus_per_worker or os.cpu_count() or 1)
        pool, where = _ThisProcess(job, encoder), "in this process"
    else:
        cluster.connect()
        nodes = cluster.nodes()
        placement = plan_placement(
            nodes, len(shards), settings.workers, settings.cpus_per_worker, settings.gpus_per_worker
        )
        pool = ActorPool(pool_config(settings, plan.shard_set, encoder, placement, nodes))
        where = f"over {placement.workers} workers of {placement}"
    start = time.monotonic()
    try:
        with progress(sum(shard.samples for shard in shards), "embedding") as meter:
            for shard, result in pool.work(shards):
                if isinstance(result, Skipped):
                    run.skipped[shard.name] = result
                    meter.note(f"{shard.name} is skipped ({result.reason}): {result.found}")
                    continue
                assert isinstance(result, ShardResult)
                run.seconds.update(result.seconds)
                run.images += shard.samples
                meter.advance(shard.samples, workers=pool.ready_workers)
    except NoWorkerStarted as error:
        raise InputError(
            f"{error}; start nodes that have them, or give --cpus-per-worker, --gpus-per-worker"
        ) from None
    except (PoolFailed, TableWriteFailed) as error:
        raise Incomplete(str(error)) from error
    elapsed, spent = time.monotonic() - start, run.seconds
    idle = max(0.0, pool.seconds - spent["infer"])
    threads = ", ".join(f"{name} {spent[name]:.1f} s" for name in ("read", "decode", "write"))
    console.print(
        f"{settings.out}: {run.images} images in {elapsed:.1f} s; {where}: infer "
        f"{spent['infer']:.1f} s, idle {idle:.1f} s, beside it {threads}"
    )
    return run


class _ThisProcess:
    """What an actor pool does, without actors: what fails unforeseen is raised, nothing retried."""

    ready_workers = 1

    def __init__(self, job: EmbedJob, encoder: EncoderSpec) -> None:
        self._embedder, self.seconds = ShardEmbedder(job, encoder), 0.0

    def work(self, shards: Iterable[Shard]) -> Iterator[tuple[Shard, ShardResult | Skipped]]:
        for remark in self._embedder.start():
            console.print(remark)
        start = time.monotonic()
        for shard in shards:
            try:
                yield shard, self._embedder.work(shard)
            except InputError as error:
                yield shard, Skipped(reason="unusable", found=str(error))
        self.seconds = time.monotonic() - start


def embed_job(
    settings: EmbeddingSettings, shards: ShardSet, cpus: int, beside_gpu: bool = False
) -> EmbedJob:
    """The job of a worker that has so many CPU cores."""
    return EmbedJob(
        shards=shards.for_workers(),
        out=settings.out,
        batch_size=settings.batch_size,
        dtype=settings.dtype,
        threads=cpus,
        decode_threads=settings.decode_threads or max(1, cpus - 1 if beside_gpu else cpus // 4),
    )


def pool_config(
    settings: EmbeddingSettings,
    shards: ShardSet,
    encoder: EncoderSpec,
    placement: Placement,
    nodes: Sequence[Node],
) -> PoolConfig:
    """The actor pool: what an actor is, and which errors skip a shard or end the stage."""
    cpus, gpus = placement.cpus, placement.gpus
    job = embed_job(settings, shards, cpus, gpus > 0)
    remote: Any = ray.remote(num_cpus=cpus, num_gpus=gpus)(ShardEmbedder)
    actor = remote.options(max_concurrency=IN_FLIGHT)
    shared = ray.put(encoder)  # the weights travel to each node once
    largest = max((node.cpus for node in nodes), default=0)
    return PoolConfig(
        create_actor=lambda: actor.remote(job, shared),
        size=placement.workers,
        resources=f"{placement}, and the largest of {len(nodes)} nodes has {largest:g} CPUs",
        in_flight=IN_FLIGHT,
        skip_on=(InputError,),
        fatal=(TableWriteFailed,),
        patience=settings.patience,
        notify=console.print,
    )


def report(
    settings: EmbeddingSettings, plan: EmbeddingPlan, run: EmbeddingRun, table: WrittenTable
) -> None:
    """Tell what has no row. Raises Incomplete where shards were skipped."""
    if table.list_changed and table.rejected:
        console.print(
            f"{len(table.rejected)} images could not be decoded: "
            f"{most_common_reasons(table.rejected)}; see {rejected_file(settings.out)}",
            style="yellow",
        )
    if run.skipped:
        reasons = "; ".join(
            f"{name} ({one.reason}: {one.found})" for name, one in sorted(run.skipped.items())
        )
        raise Incomplete(
            f"{len(run.skipped)} of {len(plan.shards)} shards could not be embedded, expected all; "
            f"the others are done; repair these and run the same command again: {reasons}"
        )
    if not plan.pending:
        console.print(f"{settings.out} is complete: {len(plan.shards)} parts; nothing to do")
