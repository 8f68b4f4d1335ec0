"""Shards -> batches: shuffled pairs of views for training, in order for embedding, by key for
pictures.

In: a set of shards. Out: batches of images as bytes (B, 3, H, W) with their labels. What is seen
when is a pure function of the seed, the epoch and the rank, so a run that is continued sees what it
would have seen.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
import numpy.typing as npt

from pipeline.batches.holdout import exclude_locations, holdout_locations
from pipeline.batches.ordered import Decoded, check_unchanged, split_failed, stack
from pipeline.batches.sampler import plan_pass, read_spans, shuffled
from pipeline.core.errors import InputError
from pipeline.core.prefetch import prefetch_map
from pipeline.core.records import Split, View, key_matches
from pipeline.images.decode import DecodeError, decode
from pipeline.images.transforms import Augmentation, Resizer, augment
from pipeline.shards.manifest import Manifest, read_manifest, repair_hint
from pipeline.shards.samples import Sample


@dataclass(frozen=True, kw_only=True)
class Batch:
    """Images of one view."""

    images_B3HW: npt.NDArray[np.uint8]
    location_B: npt.NDArray[np.int64]
    "Class numbers, as the manifest's classes are in order."
    view: View
    keys: tuple[str, ...]
    damaged: tuple[str, ...] = ()
    """Keys of images that could not be decoded; the first image of the batch that could stands in
    their places."""


@dataclass(frozen=True, kw_only=True)
class StreamConfig:
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
    "Share of the locations that is left out: `holdout_locations` of the stream."


class TrainingStream:
    """Pairs of batches of a set's training split, drawn independently from each view.

    An epoch is one pass over the satellite view; its last partial batch is dropped, other images
    each time. The UAV view gives as many images, drawn anew each epoch.

    Raises InputError when the set cannot be trained on.
    """

    def __init__(self, shards: str, reading: StreamConfig, rank: int = 0, world: int = 1) -> None:
        self.shards, self.reading, self.rank, self.world = shards, reading, rank, world
        self.manifest: Manifest = read_manifest(shards)
        self.held_out = holdout_locations(self.manifest.classes, reading.hold_out)
        kept = [location for location in self.manifest.classes if location not in self.held_out]
        self.classes = {location: number for number, location in enumerate(kept)}
        self._shards = {
            view: exclude_locations(shards, self.manifest.of(Split.TRAIN, view), self.held_out)
            for view in (View.DRONE, View.SATELLITE)
        }
        counts = {
            view: sum(shard.samples for shard in found) for view, found in self._shards.items()
        }
        together = reading.batch_size * world
        self.steps = counts[View.SATELLITE] // together
        "Steps of an epoch, the same for every rank."
        if self.steps == 0 or counts[View.DRONE] == 0:
            raise InputError(
                f"{shards} has {counts[View.SATELLITE]} satellite and {counts[View.DRONE]} UAV training images; expected at "
                f"least one batch of {together} satellite images and some of the UAV; pack more, or train with a smaller batch"
            )

    def epoch(self, epoch: int, skip: int = 0) -> Iterator[tuple[Batch, Batch]]:
        """The (UAV, satellite) batches of one epoch, a pure function of seed, epoch, rank and
        world.

        The first `skip` batches are left out, without decoding them; those that follow are what
        they always are.
        """
        return zip(
            self._view(View.DRONE, epoch, skip),
            self._view(View.SATELLITE, epoch, skip),
            strict=True,
        )

    def _view(self, view: View, epoch: int, skip: int) -> Iterator[Batch]:
        reading, wanted = self.reading, self.steps * self.reading.batch_size
        number = list(View).index(view)
        # The plan is every rank's alike; the order within a rank is its own.
        plan_rng = np.random.default_rng([reading.seed, epoch, number])
        spans = plan_pass(self._shards[view], wanted, self.rank, self.world, plan_rng)
        order_rng = np.random.default_rng([reading.seed, epoch, number, self.rank])
        samples = shuffled(
            read_spans(self.shards, spans, self.held_out), reading.shuffle_buffer, order_rng
        )

        def prepare(numbered: tuple[int, Sample]) -> Decoded:
            position, sample = numbered
            # A generator for each image: what becomes of it does not depend on which thread had it.
            rng = np.random.default_rng([reading.seed, epoch, number, self.rank, position])
            try:
                check_unchanged(sample)
                image_HW3 = decode(sample.data)
            except DecodeError as error:
                return sample, error
            return sample, augment(
                image_HW3, view, reading.image_size, reading.augmentation, rng, reading.resizer
            )

        numbered = islice(enumerate(samples), skip * reading.batch_size, None)
        prepared = prefetch_map(prepare, numbered, reading.threads, 4 * reading.batch_size)
        while group := list(islice(prepared, reading.batch_size)):
            whole, damaged = split_failed(group)
            if not whole:
                raise InputError(
                    f"not one of {len(group)} {view} images of a batch from {self.shards} can be decoded ({damaged[0]} and "
                    "on), expected at least one; pack these shards again"
                )
            # A batch keeps its size, and what stands in is a function of the data alone.
            chosen = [
                (sample, image) if not isinstance(image, DecodeError) else whole[0]
                for sample, image in group
            ]
            yield Batch(
                images_B3HW=stack([image for _, image in chosen]),
                location_B=np.asarray(
                    [self._class(sample, view) for sample, _ in chosen], np.int64
                ),
                view=view,
                keys=tuple(sample.key for sample, _ in chosen),
                damaged=tuple(damaged),
            )

    def _class(self, sample: Sample, view: View) -> int:
        """An image's label. The key says it too, and the tar's headers have checksums."""
        location = sample.facts["location"]
        if location not in self.classes or not key_matches(sample.key, Split.TRAIN, view, location):
            raise InputError(
                f"image {sample.key} of {self.shards} is of location {location!r}, expected the one of its key and of "
                f"the manifest's {len(self.classes)}; {repair_hint(self.shards)}"
            )
        return self.classes[location]
