"""Shards -> shuffled pairs of batches for training, by a webdataset pipeline.

In: a ShardSet. Out: batches of images as bytes (B, 3, H, W) with their labels. Which images come
when is a pure function of the seed, the epoch and the rank, so a resumed run sees the same images.
"""

import random
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain, count, islice
from typing import Any

import numpy as np
import numpy.typing as npt
import webdataset as wds

from pipeline.batches.holdout import exclude_locations, holdout_locations
from pipeline.batches.kept import KeptShards
from pipeline.batches.ordered import Decoded, is_damaged, split_failed, stack
from pipeline.batches.pairs import (
    SatelliteImages,
    group_distinct,
    location_of,
    plan_locations,
    take_planned,
)
from pipeline.batches.sampler import Span, plan_pass, read_spans
from pipeline.batches.settings import StreamConfig
from pipeline.core.errors import InputError
from pipeline.core.prefetch import In, Out, items_together, prefetch_map
from pipeline.core.records import Split, View, key_matches
from pipeline.images.augmentation import augment
from pipeline.images.decode import DecodeError
from pipeline.shards.samples import Sample
from pipeline.shards.shard_set import ShardSet


@dataclass(frozen=True, kw_only=True)
class Batch:
    """Images of one view."""

    images_B3HW: npt.NDArray[np.uint8]
    location_B: npt.NDArray[np.int64]
    "Class numbers, in the order of the manifest's classes."
    view: View
    keys: tuple[str, ...]
    damaged: tuple[str, ...] = ()
    """Keys of images that could not be decoded; the batch's first image that could replaces them.
    """


class TrainingStream:
    """Pairs of batches of a set's training split, drawn from the views as the sampler says.

    An epoch is one pass over the satellite view; its last partial batch is dropped, other images
    each time. The UAV view gives as many images, drawn anew each epoch. With `unique_pairs` the UAV
    view is drawn so, and each image brings its location's satellite image along. With `paired` an
    epoch is `pair_repeats` pairs of each location.

    Raises InputError when the set cannot be trained on.
    """

    def __init__(
        self, shards: ShardSet, config: StreamConfig, rank: int = 0, world: int = 1
    ) -> None:
        self.shards, self.config, self.rank, self.world = shards, config, rank, world
        classes = shards.manifest.classes
        self.held_out = holdout_locations(classes, config.hold_out)
        kept = [location for location in classes if location not in self.held_out]
        self.classes = {location: number for number, location in enumerate(kept)}
        self._shards = {
            view: exclude_locations(shards, shards.manifest.of(Split.TRAIN, view), self.held_out)
            for view in (View.DRONE, View.SATELLITE)
        }
        self._kept = KeptShards(shards, config)
        counts = {
            view: sum(shard.samples for shard in found) for view, found in self._shards.items()
        }
        together = config.batch_size * world
        self.steps = counts[View.SATELLITE] // together
        "Steps of an epoch, the same for every rank."
        if config.sampler == "paired":
            self._require_locations(-(-config.batch_size // config.pair_repeats) * world)
            self.steps = len(kept) // world * config.pair_repeats // config.batch_size
        if self.steps == 0 or counts[View.DRONE] == 0:
            raise InputError(
                f"{shards.path} has {counts[View.SATELLITE]} satellite and {counts[View.DRONE]} "
                f"UAV training images; expected at least one batch of {together} satellite images "
                "and some of the UAV; pack more, or train with a smaller batch"
            )

    def epoch(self, epoch: int, skip: int = 0) -> Iterator[tuple[Batch, Batch]]:
        """The (UAV, satellite) batches of one epoch, a pure function of seed, epoch, rank and
        world.

        The first `skip` batches are skipped without decoding them; the others are those of a full
        epoch.
        """
        if self.config.sampler != "independent":
            return self._paired_epoch(epoch, skip)
        return zip(
            self.pipeline(View.DRONE, epoch, skip),
            self.pipeline(View.SATELLITE, epoch, skip),
            strict=True,
        )

    def _require_locations(self, fewest: int) -> None:
        if len(self.classes) < fewest:
            raise InputError(
                f"{self.shards.path} has {len(self.classes)} training locations, expected at least "
                f"{fewest} for one batch of pairs; train with a smaller batch"
            )

    def _paired_epoch(self, epoch: int, skip: int) -> Iterator[tuple[Batch, Batch]]:
        size = self.config.batch_size
        drones = self._drones_of_pairs(epoch)
        rows = enumerate(islice(drones, skip * size, self.steps * size), start=skip * size)
        for group in wds.batched(size, collation_fn=None)(
            self._by_threads(partial(self._prepare_pair, self._satellites, epoch), rows)
        ):
            yield self._collate_pairs(group)

    def _drones_of_pairs(self, epoch: int) -> Iterator[Sample]:
        """The UAV samples of an epoch's pairs in their order, and with `unique_pairs` more."""
        config, rows = self.config, self.steps * self.config.batch_size
        shards, view = self._shards[View.DRONE], list(View).index(View.DRONE)
        if config.sampler == "unique_pairs":
            self._require_locations(config.batch_size)
            # Over and over: groups of distinct locations may take more samples than they keep.
            rng = np.random.default_rng([config.seed, epoch, view])
            passes = (plan_pass(shards, rows, self.rank, self.world, rng) for _ in count())
            drones = self._shuffled_drones(epoch, chain.from_iterable(passes))
            groups = group_distinct(drones, location_of, config.batch_size)
            return chain.from_iterable(groups)
        # Each pass is over all samples: as many passes as repeats are enough for any location that
        # has one, and the stream ends if a location has none.
        repeats, every = config.pair_repeats, sum(shard.samples for shard in shards)
        rng = np.random.default_rng([config.seed, epoch, view, self.rank])
        passes = (plan_pass(shards, every, 0, 1, rng) for _ in range(repeats))
        drones = self._shuffled_drones(epoch, chain.from_iterable(passes))
        names, order = list(self.classes), np.random.default_rng([config.seed, epoch, len(View)])
        planned = plan_locations(names, repeats, rows, self.rank, self.world, order)
        return take_planned(drones, location_of, planned, self.shards.path)

    def _shuffled_drones(self, epoch: int, spans: Iterator[Span]) -> Iterator[Sample]:
        """The UAV samples of these spans, shuffled."""
        config = self.config
        rng = random.Random(repr((config.seed, epoch, View.DRONE.value, self.rank)))
        buffer = min(config.shuffle_buffer, sum(s.samples for s in self._shards[View.DRONE]))
        shuffled = wds.shuffle(buffer, initial=buffer, rng=rng)
        samples: Iterator[Sample] = shuffled(read_spans(self._kept, self.held_out, spans))
        return samples

    @cached_property
    def _satellites(self) -> SatelliteImages:
        return SatelliteImages(self._kept, self._shards[View.SATELLITE], self.held_out)

    def _prepare_pair(
        self, satellites: SatelliteImages, epoch: int, numbered: tuple[int, Sample]
    ) -> tuple[Decoded, Decoded]:
        number, drone = numbered
        rng = np.random.default_rng([self.config.seed, epoch, len(View), self.rank, number])
        satellite = satellites.one_of(location_of(drone), rng)
        mirrored = self.config.augmentation.pair_mirror and rng.random() < 0.5
        return (
            self._prepare(View.DRONE, epoch, number, drone, mirrored),
            self._prepare(View.SATELLITE, epoch, number, satellite, mirrored),
        )

    def _collate_pairs(self, group: list[tuple[Decoded, Decoded]]) -> tuple[Batch, Batch]:
        """A batch of each view. A pair with a damaged image is replaced by the first intact one."""
        views = (View.DRONE, View.SATELLITE)
        damaged = {
            view: tuple(pair[side][0].key for pair in group if is_damaged(pair[side]))
            for side, view in enumerate(views)
        }
        intact = next((pair for pair in group if not any(map(is_damaged, pair))), None)
        if intact is None:
            first = (damaged[View.DRONE] + damaged[View.SATELLITE])[0]
            raise InputError(
                f"not one of {len(group)} pairs of a batch from {self.shards.path} can be decoded "
                f"({first} and on), expected at least one; pack these shards again"
            )
        chosen = [intact if any(map(is_damaged, pair)) else pair for pair in group]
        drones, satellites = (
            replace(self._collate(view, [pair[side] for pair in chosen]), damaged=damaged[view])
            for side, view in enumerate(views)
        )
        return drones, satellites

    def pipeline(self, view: View, epoch: int, skip: int = 0) -> Any:
        """The batches of one view and epoch: a `webdataset.DataPipeline` of `Batch`, to iterate
        over or to extend with `compose`.
        """
        batched = wds.batched(
            self.config.batch_size, collation_fn=partial(self._collate, view), partial=False
        )
        return self.sample_pipeline(view, epoch, skip).compose(
            partial(self._decode, view, epoch), batched
        )

    def sample_pipeline(self, view: View, epoch: int, skip: int = 0) -> Any:
        """The encoded samples of one view and epoch in their order, each with its number in the
        epoch: a `webdataset.DataPipeline` of (int, Sample), to compose with stages of your own.

        The samples of the first `skip` batches are read and dropped.
        """
        config = self.config
        rng = random.Random(repr((config.seed, epoch, view.value, self.rank)))
        return wds.DataPipeline(
            partial(self.plan, view, epoch),
            partial(read_spans, self._kept, self.held_out),
            wds.shuffle(config.shuffle_buffer, initial=config.shuffle_buffer, rng=rng),
            enumerate,
            wds.slice(skip * config.batch_size, None),
        )

    def plan(self, view: View, epoch: int) -> Iterator[Span]:
        """The spans of one view and epoch that this rank reads."""
        # The plan is the same on every rank; the order within a rank is its own.
        rng = np.random.default_rng([self.config.seed, epoch, list(View).index(view)])
        wanted = self.steps * self.config.batch_size
        yield from plan_pass(self._shards[view], wanted, self.rank, self.world, rng)

    def _decode(
        self, view: View, epoch: int, numbered: Iterable[tuple[int, Sample]]
    ) -> Iterator[Decoded]:
        """The samples' images, decoded and augmented, in order."""
        return self._by_threads(lambda one: self._prepare(view, epoch, *one), numbered)

    def _by_threads(self, prepare: Callable[[In], Out], items: Iterable[In]) -> Iterator[Out]:
        """`prepare` of each item in order, by threads that work up to four batches ahead."""
        ahead = 4 * self.config.batch_size
        together = items_together(self.config.threads, ahead)
        return prefetch_map(prepare, items, self._threads, ahead, together)

    @cached_property
    def _threads(self) -> ThreadPoolExecutor:
        """Those of both views: more than are asked for would only wait for each other."""
        return ThreadPoolExecutor(self.config.threads)

    def _prepare(
        self, view: View, epoch: int, number: int, sample: Sample, mirrored: bool = False
    ) -> Decoded:
        """One image, decoded, mirrored along with its pair's other image, and augmented."""
        config = self.config
        # A generator for each image, so that its augmentation does not depend on the thread.
        seed = [config.seed, epoch, list(View).index(view), self.rank, number]
        try:
            image_HW3 = self._kept.open(sample)
        except DecodeError as error:
            return sample, error
        return sample, augment(
            image_HW3[:, ::-1] if mirrored else image_HW3,
            view,
            config.image_size,
            config.augmentation,
            np.random.default_rng(seed),
            config.resizer,
        )

    def _collate(self, view: View, group: list[Decoded]) -> Batch:
        """One batch. Raises InputError where none of its images can be decoded."""
        intact, damaged = split_failed(group)
        if not intact:
            raise InputError(
                f"not one of {len(group)} {view} images of a batch from {self.shards.path} can be "
                f"decoded ({damaged[0]} and on), expected at least one; pack these shards again"
            )
        # A batch keeps its size, and the replacement is a function of the data alone.
        chosen = [
            (sample, image) if not isinstance(image, DecodeError) else intact[0]
            for sample, image in group
        ]
        return Batch(
            images_B3HW=stack([image for _, image in chosen]),
            location_B=np.asarray([self._class(sample, view) for sample, _ in chosen], np.int64),
            view=view,
            keys=tuple(sample.key for sample, _ in chosen),
            damaged=tuple(damaged),
        )

    def _class(self, sample: Sample, view: View) -> int:
        """An image's class number. Where the key states the location too, the two are compared."""
        location, keyed = sample.metadata["location"], self.shards.keys_state_location
        agrees = not keyed or key_matches(sample.key, Split.TRAIN, view, location)
        if location not in self.classes or not agrees:
            raise InputError(
                f"image {sample.key} of {self.shards.path} is of location {location!r}, expected "
                f"the one of its key and of the manifest's {len(self.classes)}; "
                f"{self.shards.repair_hint}"
            )
        return self.classes[location]
