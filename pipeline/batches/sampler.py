"""TODO pipeline.batches.sampler."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from pipeline.shards.manifest import Shard
from pipeline.shards.samples import Sample, read_shard


@dataclass(frozen=True, kw_only=True)
class Span:
    """A run of samples within one shard."""

    name: str
    start: int
    stop: int


def plan_pass(
    shards: Sequence[Shard], wanted: int, rank: int, world: int, rng: np.random.Generator
) -> list[Span]:
    """The spans that `rank` of `world` reads so that all ranks together see `world * wanted`
    samples of these shards.

    The shards in random order form a ring, entered at a random sample: which samples fall off at
    the end differs from pass to pass, and no two ranks see the same one while the ring is long
    enough. A shorter ring is gone round again.
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
                spans.append(Span(name=shard.name, start=inside, stop=inside + take))
                break
            inside -= shard.samples
        position, wanted = (position + take) % total, wanted - take
    return spans


def read_spans(
    shards: str, spans: Iterable[Span], left_out: frozenset[str] = frozenset()
) -> Iterator[Sample]:
    """The spans' samples; those of the locations that are left out do not count as there."""
    for span in spans:
        samples = (
            sample
            for sample in read_shard(shards, span.name)
            if sample.facts["location"] not in left_out
        )
        yield from islice(samples, span.start, span.stop)


def shuffled(samples: Iterable[Sample], buffer: int, rng: np.random.Generator) -> Iterator[Sample]:
    """Samples in random order as far as `buffer` encoded images allow."""
    held: list[Sample] = []
    for sample in samples:
        if len(held) < buffer:
            held.append(sample)
            continue
        chosen = int(rng.integers(buffer))
        yield held[chosen]
        held[chosen] = sample
    for chosen in rng.permutation(len(held)):
        yield held[chosen]
