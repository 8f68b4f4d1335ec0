"""Shards -> batches: shuffled pairs of views for training, in order for embedding, by key for pictures.

In: a set of shards. Out: batches of images as bytes (B, 3, H, W) with their labels. What is seen when is a pure function
of the seed, the epoch and the rank, so a run that is continued sees what it would have seen.
"""

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
import numpy.typing as npt

from pipeline import storage
from pipeline.ahead import ahead
from pipeline.hold_out import held_out, without
from pipeline.records import InputError, Split, View, key_names
from pipeline.samples import Sample, read_shard
from pipeline.shards import Manifest, Shard, mending, read_manifest
from pipeline.tars import IMAGES, read_tar
from pipeline.transforms import Augmentation, DecodeError, Pixels, Resizer, augment, decode, resize

Opened = tuple[Sample, Pixels | DecodeError]
"A sample and its pixels, or why there are none."
CHANGED = "changed since it was packed"


@dataclass(frozen=True, kw_only=True)
class Batch:
    """Images of one view."""

    images_B3HW: npt.NDArray[np.uint8]
    location_B: npt.NDArray[np.int64]
    "Class numbers, as the manifest's classes are in order."
    view: View
    keys: tuple[str, ...]
    damaged: tuple[str, ...] = ()
    "Keys of images that could not be decoded; the first image of the batch that could stands in their places."


@dataclass(frozen=True, kw_only=True)
class Span:
    """A run of samples within one shard."""

    name: str
    start: int
    stop: int


def plan_pass(shards: Sequence[Shard], wanted: int, rank: int, world: int, rng: np.random.Generator) -> list[Span]:
    """The spans that `rank` of `world` reads so that all ranks together see `world * wanted` samples of these shards.

    The shards in random order form a ring, entered at a random sample: which samples fall off at the end differs from
    pass to pass, and no two ranks see the same one while the ring is long enough. A shorter ring is gone round again.
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


def read_spans(shards: str, spans: Iterable[Span], left_out: frozenset[str] = frozenset()) -> Iterator[Sample]:
    """The spans' samples; those of the locations that are left out do not count as there."""
    for span in spans:
        samples = (sample for sample in read_shard(shards, span.name) if sample.facts["location"] not in left_out)
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


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How training images are read."""

    batch_size: int = 8
    "Images of each view per step and worker [LPN lineage: 8]."
    image_size: int = 256
    "Side in pixels that the network is given."
    resizer: Resizer = "torch"
    "Whose bicubic brings images to that size."
    augmentation: Augmentation = field(default_factory=Augmentation)
    seed: int = 0
    shuffle_buffer: int = 4096
    "Encoded images held for shuffling; those of University-1652 take some 40 kB each."
    threads: int = 2
    "That decode and augment ahead of the network."
    hold_out: float = 0.0
    "Share of the locations that is left out: `held_out` of the stream."


class TrainingStream:
    """Pairs of batches of a set's training split, drawn independently from each view.

    An epoch is one pass over the satellite view; its last partial batch is dropped, other images each time. The UAV view
    gives as many images, drawn anew each epoch.

    Raises InputError when the set cannot be trained on.
    """

    def __init__(self, shards: str, reading: Reading, rank: int = 0, world: int = 1) -> None:
        self.shards, self.reading, self.rank, self.world = shards, reading, rank, world
        self.manifest: Manifest = read_manifest(shards)
        self.held_out = held_out(self.manifest.classes, reading.hold_out)
        kept = [location for location in self.manifest.classes if location not in self.held_out]
        self.classes = {location: number for number, location in enumerate(kept)}
        self._shards = {
            view: without(shards, self.manifest.of(Split.TRAIN, view), self.held_out)
            for view in (View.DRONE, View.SATELLITE)
        }
        counts = {view: sum(shard.samples for shard in found) for view, found in self._shards.items()}
        together = reading.batch_size * world
        self.steps = counts[View.SATELLITE] // together
        "Steps of an epoch, the same for every rank."
        if self.steps == 0 or counts[View.DRONE] == 0:
            raise InputError(
                f"{shards} has {counts[View.SATELLITE]} satellite and {counts[View.DRONE]} UAV training images; expected at "
                f"least one batch of {together} satellite images and some of the UAV; pack more, or train with a smaller batch"
            )

    def epoch(self, epoch: int, skip: int = 0) -> Iterator[tuple[Batch, Batch]]:
        """The (UAV, satellite) batches of one epoch, a pure function of seed, epoch, rank and world.

        The first `skip` batches are left out, without decoding them; those that follow are what they always are.
        """
        return zip(self._view(View.DRONE, epoch, skip), self._view(View.SATELLITE, epoch, skip), strict=True)

    def _view(self, view: View, epoch: int, skip: int) -> Iterator[Batch]:
        reading, wanted = self.reading, self.steps * self.reading.batch_size
        number = list(View).index(view)
        # The plan is every rank's alike; the order within a rank is its own.
        plan_rng = np.random.default_rng([reading.seed, epoch, number])
        spans = plan_pass(self._shards[view], wanted, self.rank, self.world, plan_rng)
        order_rng = np.random.default_rng([reading.seed, epoch, number, self.rank])
        samples = shuffled(read_spans(self.shards, spans, self.held_out), reading.shuffle_buffer, order_rng)

        def prepare(numbered: tuple[int, Sample]) -> Opened:
            position, sample = numbered
            # A generator for each image: what becomes of it does not depend on which thread had it.
            rng = np.random.default_rng([reading.seed, epoch, number, self.rank, position])
            try:
                refuse_changed(sample)
                image_HW3 = decode(sample.data)
            except DecodeError as error:
                return sample, error
            return sample, augment(image_HW3, view, reading.image_size, reading.augmentation, rng, reading.resizer)

        numbered = islice(enumerate(samples), skip * reading.batch_size, None)
        prepared = ahead(prepare, numbered, reading.threads, 4 * reading.batch_size)
        while group := list(islice(prepared, reading.batch_size)):
            whole, damaged = sound(group)
            if not whole:
                raise InputError(
                    f"not one of {len(group)} {view} images of a batch from {self.shards} can be decoded ({damaged[0]} and "
                    "on), expected at least one; pack these shards again"
                )
            # A batch keeps its size, and what stands in is a function of the data alone.
            chosen = [(sample, image) if not isinstance(image, DecodeError) else whole[0] for sample, image in group]
            yield Batch(
                images_B3HW=stack([image for _, image in chosen]),
                location_B=np.asarray([self._class(sample, view) for sample, _ in chosen], np.int64),
                view=view,
                keys=tuple(sample.key for sample, _ in chosen),
                damaged=tuple(damaged),
            )

    def _class(self, sample: Sample, view: View) -> int:
        """An image's label. The key says it too, and the tar's headers have checksums."""
        location = sample.facts["location"]
        if location not in self.classes or not key_names(sample.key, Split.TRAIN, view, location):
            raise InputError(
                f"image {sample.key} of {self.shards} is of location {location!r}, expected the one of its key and of "
                f"the manifest's {len(self.classes)}; {mending(self.shards)}"
            )
        return self.classes[location]


def refuse_changed(sample: Sample) -> None:
    """Raise DecodeError where an image is not the one that was packed: 25 us, where decoding takes a millisecond or more."""
    said = sample.facts.get("sha256")
    if said is not None and hashlib.sha256(sample.data).hexdigest() != said:
        raise DecodeError(CHANGED, "other bytes than were packed")


def stack(images_HW3: Sequence[Pixels]) -> npt.NDArray[np.uint8]:
    """Images of one size as (B, 3, H, W), channels last in memory, which is how the network wants them."""
    return np.stack(images_HW3).transpose(0, 3, 1, 2)


def decoded(
    samples: Iterable[Sample], image_size: int, threads: int, depth: int, resizer: Resizer = "torch"
) -> Iterator[Opened]:
    """The samples' images in order, decoded and resized by threads; what cannot be decoded comes as its error."""
    return ahead(lambda sample: opened(sample, image_size, resizer), samples, threads, depth)


def opened(sample: Sample, image_size: int, resizer: Resizer = "torch") -> Opened:
    """One sample's image, decoded and resized, or why it cannot be."""
    try:
        refuse_changed(sample)
        return sample, resize(decode(sample.data), image_size, resizer)
    except DecodeError as error:
        return sample, error


def sound(images: Iterable[Opened]) -> tuple[list[tuple[Sample, Pixels]], list[str]]:
    """The images that could be decoded, and the keys of the others."""
    whole: list[tuple[Sample, Pixels]] = []
    damaged: list[str] = []
    for sample, image in images:
        if isinstance(image, DecodeError):
            damaged.append(sample.key)
        else:
            whole.append((sample, image))
    return whole, damaged


def fetch(shards: str, keys: Iterable[str]) -> dict[str, bytes]:
    """The encoded images of some keys; keys that no shard holds are absent."""
    wanted = set(keys)
    found: dict[str, bytes] = {}
    for shard in read_manifest(shards).shards:
        prefix = f"{shard.split}-{shard.view}-"
        if any(key.startswith(prefix) for key in wanted):
            members = read_tar(storage.join(shards, f"{shard.name}.tar"), IMAGES)
            found |= {key: next(iter(images.values())) for key, images in members if key in wanted}
    return found
