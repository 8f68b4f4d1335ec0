"""Which samples a rank reads in an epoch: spans of shards, planned from random numbers alone.

In: the shards of a view with their counts. Out: spans, and their samples. The planner does no I/O.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from pipeline.batches.kept import KeptShards
from pipeline.core.errors import InputError
from pipeline.shards.manifest import Shard
from pipeline.shards.samples import Sample


@dataclass(frozen=True, kw_only=True)
class Span:
    """A run of samples within one shard."""

    shard: Shard
    start: int
    stop: int


def plan_pass(
    shards: Sequence[Shard], wanted: int, rank: int, world: int, rng: np.random.Generator
) -> list[Span]:
    """The spans that `rank` of `world` reads so that all ranks together see `world * wanted`
    samples of these shards.

    The shards in random order form a ring, entered at a random sample: which samples are dropped at
    the end differs from pass to pass, and no two ranks see the same one while the ring is long
    enough. A shorter ring is read more than once.
    """
    order = [shards[number] for number in rng.permutation(len(shards))]
    total = sum(shard.samples for shard in order)
    if total == 0:
        return []
    position = (int(rng.integers(total)) + rank * wanted) % total
    spans: list[Span] = []
    while wanted > 0:
        inside = position
        for shard in order:
            if inside < shard.samples:
                take = min(wanted, shard.samples - inside)
                spans.append(Span(shard=shard, start=inside, stop=inside + take))
                break
            inside -= shard.samples
        position, wanted = (position + take) % total, wanted - take
    return spans


def read_spans(
    kept: KeptShards, left_out: frozenset[str], spans: Iterable[Span]
) -> Iterator[Sample]:
    """The spans' samples; samples of the locations that are left out are not counted.

    Raises InputError where a shard has fewer samples than the manifest says, which would otherwise
    end one view's batches before the other's.
    """
    for span in spans:
        samples = (
            sample
            for sample in kept.samples(span.shard)
            if sample.metadata["location"] not in left_out
        )
        read = 0
        for sample in islice(samples, span.start, span.stop):
            yield sample
            read += 1
        if read < span.stop - span.start:
            shards = kept.shards
            raise InputError(
                f"{shards.tar(span.shard)} ends before sample {span.stop}, expected the "
                f"{span.shard.samples} samples of the manifest; {shards.repair_hint}"
            )
