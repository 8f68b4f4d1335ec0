"""Plans -> tars, several at once by Ray tasks; finished tars of an interrupted packing are kept.

In: plans and what the source's scan gave. Out: the result of each tar, or TooManyRejected as soon
as too many images are refused.
"""

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import ray

from pipeline.core import cluster, rejections, storage
from pipeline.core.errors import Incomplete
from pipeline.core.progress import console, progress
from pipeline.core.records import ImageRecord, Rejection
from pipeline.shards.manifest import read_damaged
from pipeline.shards.plan import ShardPlan
from pipeline.shards.record_table import FOLDER, Packed, part_intact, read_packed
from pipeline.shards.settings import PackingSettings
from pipeline.shards.writer import UNREADABLE, write_shard
from pipeline.sources.base import Source

IMAGE_S = 0.005
"""About what an image takes a core, between a file that is copied (0.3 ms) and a tile that is cut
from a map: fewer of them do not wait for Ray."""


class TooManyRejected(Incomplete):
    """More images were refused than `max_bad_fraction` allows."""


@dataclass
class ScanResult:
    """The records that a source found, and the images refused so far."""

    records: list[ImageRecord]
    rejected: list[Rejection]
    found: int
    "Images before any were refused."
    known: int = 0
    "Images that the set holds already."


def pack_plans(
    plans: Sequence[ShardPlan],
    source: Source,
    settings: PackingSettings,
    config: dict[str, Any],
    scanned: ScanResult,
    duplicates: Mapping[str, dict[str, str]] | None = None,
) -> dict[str, Packed]:
    """The result of each plan's tar, by name: loaded where the tar is finished, else packed now.

    `config`: the settings that determine a tar's content. With `duplicates`, all tars are packed,
    without these images. Raises TooManyRejected as soon as that is certain.
    """
    out, packed = storage.absolute(settings.out), dict[str, Packed]()
    digests = {plan.name: plan.digest(config) for plan in plans}
    if duplicates is None:
        sizes = storage.walk(out) if storage.is_folder(out) else {}
        for name in read_damaged(out):
            sizes.pop(f"{name}.tar", None)
        packed = {
            name: done
            for name in digests
            if (done := load_if_done(out, name, digests[name], sizes)) is not None
        }
        if packed:
            console.print(f"{len(packed)} of {len(plans)} shards are packed already")
    todo = [plan for plan in plans if plan.name not in packed]
    refused, megabytes, began = list(scanned.rejected), 0.0, time.monotonic()
    images = sum(len(plan.records) for plan in todo)
    with progress(images, "packing") as meter:
        left_out = duplicates or {}
        arguments = (
            (plan, source, out, digests[plan.name], settings.check, left_out.get(plan.name))
            for plan in todo
        )
        # One tar is one task: nothing runs beside it.
        alone = settings.workers is None and len(todo) <= 1
        workers = 0 if alone else cluster.workers_for(settings.workers, images * IMAGE_S)
        for done in write_shards(arguments, workers):
            packed[done.shard.name] = done
            refused += done.rejected
            megabytes += done.shard.bytes / 1e6
            rate = f"{megabytes / (time.monotonic() - began):.1f}"
            count = done.shard.samples + len(done.rejected)
            meter.advance(count, refused=len(refused), megabytes_per_second=rate)
            check_rejections(settings, refused, scanned.found)
    return packed


def load_if_done(out: str, name: str, digest: str, sizes: Mapping[str, int]) -> Packed | None:
    """The result of this very plan, where its tar is finished; None where it holds less because of
    images that could not be read, which are tried again.
    """
    done = read_packed(out, name) if f"{FOLDER}/{name}.parquet" in sizes else None
    if done is None or done.plan != digest or sizes.get(f"{name}.tar") != done.shard.bytes:
        return None
    if any(rejection.reason == UNREADABLE for rejection in done.rejected):
        return None
    return done if part_intact(out, name) else None


def write_shards(arguments: Iterable[tuple[Any, ...]], workers: int | None) -> Iterator[Packed]:
    """`write_shard` of each of the arguments; results come as they are finished."""
    if workers == 0:
        yield from (write_shard(*given) for given in arguments)
        return
    cluster.connect()
    task = ray.remote(num_cpus=1)(write_shard)
    window = workers or 2 * cluster.cpus()
    results = cluster.bounded_map(lambda given: task.remote(*given), arguments, window)
    yield from (done for _, done in results)


def check_rejections(settings: PackingSettings, refused: Sequence[Rejection], found: int) -> None:
    """Raise TooManyRejected, with the list written, if too many images were refused. When
    extending, an image that the set holds already does not count.
    """
    bad = [one for one in refused if not (settings.extend and one.reason == "duplicate")]
    if len(bad) <= settings.max_bad_fraction * found:
        return
    rejections.write_rejections(settings.out, refused, keep=settings.extend)
    raise TooManyRejected(
        f"{len(bad)} of {found} images were refused, more than {settings.max_bad_fraction:.2%}: "
        f"{rejections.most_common_reasons(bad)}; see "
        f"{storage.join(settings.out, rejections.REJECTED_FILE)}, repair them or raise "
        "--max-bad-fraction"
    )
