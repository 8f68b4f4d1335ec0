"""Training images that stay in memory from epoch to epoch, as many shards as fit.

In: shards, which every epoch reads again. Out: their samples, and the samples' images. What is kept
was read, decoded and resized once; the images are the same as without.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

from pipeline.batches.ordered import open_image
from pipeline.batches.settings import StreamConfig
from pipeline.core.arrays import Pixels
from pipeline.core.records import Split, View
from pipeline.images.transforms import resize
from pipeline.shards.manifest import Shard
from pipeline.shards.samples import Sample
from pipeline.shards.shard_set import ShardSet


@dataclass(frozen=True, kw_only=True)
class KeptSample(Sample):
    """A sample that stays in memory."""

    opened: list[Pixels] = field(default_factory=list, compare=False)
    "Its image at the network's size; empty until it is first opened."


class KeptShards:
    """A set's training shards. Those are kept, from their first reading on, whose tars and images
    at the network's size fit into `keep_bytes` together: satellite images first, all of which an
    epoch reads.

    Images are kept where resizing them is the first step of the augmentation.
    """

    def __init__(self, shards: ShardSet, config: StreamConfig) -> None:
        self.shards, self._config = shards, config
        chosen = config.augmentation
        self._resizes_first = chosen.chain == "own" and not chosen.pair_mirror
        self._fitting = frozenset(self._that_fit())
        self._kept: dict[str, list[KeptSample]] = {}

    def _that_fit(self) -> Iterator[str]:
        """Names of the shards to keep."""
        left = self._config.keep_bytes
        image_bytes = 3 * self._config.image_size**2 if self._resizes_first else 0
        for view in (View.SATELLITE, View.DRONE):
            for shard in self.shards.manifest.of(Split.TRAIN, view):
                size = shard.bytes + shard.samples * image_bytes
                if size <= left:
                    left -= size
                    yield shard.name

    def samples(self, shard: Shard) -> Iterator[Sample]:
        """The samples of a shard in their order. Raises InputError as `ShardSet.samples` does."""
        if shard.name not in self._fitting:
            return self.shards.samples(shard)
        if shard.name not in self._kept:
            self._kept[shard.name] = [
                KeptSample(key=sample.key, data=sample.data, metadata=sample.metadata)
                for sample in self.shards.samples(shard)
            ]
        return iter(self._kept[shard.name])

    def open(self, sample: Sample) -> Pixels:
        """A sample's pixels (H, W, 3), resized already where the augmentation begins with that.

        Raises DecodeError. Threads may call it; two of them decode the same image at worst.
        """
        if isinstance(sample, KeptSample) and sample.opened:
            return sample.opened[0]
        image_HW3 = open_image(sample, self._config.perspective)
        if self._resizes_first:
            image_HW3 = resize(image_HW3, self._config.image_size, self._config.resizer)
            if isinstance(sample, KeptSample):
                sample.opened.append(image_HW3)
        return image_HW3
