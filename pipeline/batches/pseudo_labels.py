"""Pseudo-labels: which satellite image each UAV image is taken to show, where nobody has said so.

In: embeddings of both views; a set of shards. Out: pairs of mutual neighbours, and the set as
training reads it with these pairs in place of its labels, which are out of its reach.
Shapes: U UAV images, S satellite images, E numbers of an embedding, B rows of a block.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from pipeline.core.arrays import Floats, Ints
from pipeline.core.records import Split, View
from pipeline.shards.manifest import Shard
from pipeline.shards.samples import Sample
from pipeline.shards.shard_set import ShardSet

UNPAIRED = -1
BLOCK = 1024
"UAV images whose cosines are in memory at once."


def mutual_neighbours(
    drone_UE: Floats, satellite_SE: Floats, neighbours: int = 1, margin: float = 0.0
) -> Ints:
    """The satellite image (U,) of each UAV image, by its row, or UNPAIRED.

    A UAV image and a satellite image are a pair where each is near the other: the satellite image
    is the UAV image's nearest one, by `margin` or more in cosine before the second nearest; and
    fewer than `neighbours` UAV images are nearer to the satellite image. With 1 both are each
    other's nearest. Of equally near satellite images the first is taken. Rows are of length 1.

    After mutual nearest neighbours as UniABG pairs the views without labels (arXiv 2511.12054);
    more than one UAV image for a satellite image, and the margin, are [chosen].
    """
    drones, satellites = len(drone_UE), len(satellite_SE)
    nearest_U, cosine_U = np.zeros(drones, np.int64), np.zeros(drones, np.float32)
    lead_U = np.full(drones, np.inf, np.float32)
    closest_KS = np.full((neighbours, satellites), -np.inf, np.float32)
    for start in range(0, drones, BLOCK):
        rows = slice(start, start + BLOCK)
        cosine_BS = drone_UE[rows] @ satellite_SE.T
        nearest_U[rows] = cosine_BS.argmax(1)
        cosine_U[rows] = cosine_BS.max(1)
        if satellites > 1:
            lead_U[rows] = cosine_U[rows] - np.partition(cosine_BS, -2, axis=1)[:, -2]
        seen_S = np.concatenate([closest_KS, cosine_BS])
        closest_KS = np.partition(seen_S, len(seen_S) - neighbours, axis=0)[-neighbours:]
    near_U = cosine_U >= closest_KS.min(0)[nearest_U]
    return np.where(near_U & (lead_U >= margin), nearest_U, UNPAIRED)


def training_keys(shards: ShardSet, view: View) -> list[str]:
    """Keys of a view's training images, in the shards' order, from the record table."""
    return [
        key
        for shard in shards.manifest.of(Split.TRAIN, view)
        for key in shards.records(shard, ["key"])["key"].to_pylist()
    ]


@dataclass(frozen=True, kw_only=True)
class PseudoLabelledShards(ShardSet):
    """A set whose training locations are its satellite images, each by its key, and whose UAV
    images show the one that they are paired with.

    Samples carry this label, their key, their bytes and their hash, and nothing else that the
    shards know of them. UAV images without a pair are left out. Of other splits there are none.
    """

    keys_state_location: ClassVar[bool] = False
    satellite_of: Mapping[str, str] | None
    """UAV image -> satellite image, by their keys; None before the first pairs are made: the set
    can then be counted, and not trained on."""

    def samples(self, shard: Shard, verify: bool = False) -> Iterator[Sample]:
        """The samples of one training shard. Raises InputError as the set without labels does."""
        for sample in super().samples(shard, verify):
            label = sample.key
            if shard.view != View.SATELLITE:
                if self.satellite_of is None or sample.key not in self.satellite_of:
                    continue
                label = self.satellite_of[sample.key]
            known = {name: sample.metadata[name] for name in ("sha256",) if name in sample.metadata}
            yield replace(sample, metadata=known | {"location": label})

    def locations(self, shard: Shard) -> Iterator[str]:
        """The labels of one shard's samples."""
        return (sample.metadata["location"] for sample in self.samples(shard))


def with_pseudo_labels(
    shards: ShardSet, satellite_of: Mapping[str, str] | None
) -> PseudoLabelledShards:
    """The set's training split with these labels in place of its own.

    Raises InputError where the record table cannot be read.
    """
    classes = tuple(training_keys(shards, View.SATELLITE))
    listed = shards.manifest.of(Split.TRAIN, View.SATELLITE)
    for shard in shards.manifest.of(Split.TRAIN, View.DRONE):
        if satellite_of is not None:
            keys = shards.records(shard, ["key"])["key"].to_pylist()
            shard = replace(shard, samples=sum(key in satellite_of for key in keys))
        listed.append(shard)
    manifest = replace(shards.manifest, shards=tuple(listed), classes=classes)
    return PseudoLabelledShards(path=shards.path, manifest=manifest, satellite_of=satellite_of)
