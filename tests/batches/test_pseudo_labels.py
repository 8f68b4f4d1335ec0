"""Pseudo-labels: mutual neighbours by hand, and a set that knows no labels but these."""

import numpy as np
import pytest

from pipeline.batches import pseudo_labels
from pipeline.batches.pseudo_labels import (
    UNPAIRED,
    mutual_neighbours,
    training_keys,
    with_pseudo_labels,
)
from pipeline.batches.settings import StreamConfig
from pipeline.batches.training import TrainingStream
from pipeline.core.arrays import Floats
from pipeline.core.records import Split, View
from pipeline.images.augmentation import Augmentation
from pipeline.shards.shard_set import open_shards

PAIRED = StreamConfig(
    batch_size=4,
    image_size=8,
    augmentation=Augmentation(pad=0, rotation=0, mirror=False),
    threads=1,
    sampler="unique_pairs",
)


def at(*degrees: float) -> Floats:
    """Unit vectors in the plane at these angles."""
    turned = np.radians(np.array(degrees))
    return np.stack([np.cos(turned), np.sin(turned)], axis=1).astype(np.float32)


SATELLITES = at(0, 90, 180)
DRONES = at(10, 5, 30, 50, 95, 44)
"Nearest satellites by angle: 0, 0, 0, 1, 1, 0; none is nearest to the third."


def test_mutual_nearest_neighbours_by_hand() -> None:
    # The nearest UAV images of the satellites: 5 degrees of the first, 95 of the second and third.
    found = mutual_neighbours(DRONES, SATELLITES)
    assert found.tolist() == [UNPAIRED, 0, UNPAIRED, UNPAIRED, 1, UNPAIRED]


def test_more_neighbours_take_the_next_nearest() -> None:
    assert mutual_neighbours(DRONES, SATELLITES, 2).tolist() == [0, 0, -1, 1, 1, -1]
    # The fourth nearest to the first satellite is at 44 degrees, that to the second at 30.
    assert mutual_neighbours(DRONES, SATELLITES, 4).tolist() == [0, 0, 0, 1, 1, 0]
    assert mutual_neighbours(DRONES, SATELLITES, 9).tolist() == [0, 0, 0, 1, 1, 0]


def test_margin_refuses_what_lies_between_two() -> None:
    # cos 44 - cos 46 = 0.025; cos 40 - cos 50 = 0.123; cos 30 - cos 60 = 0.366
    assert mutual_neighbours(DRONES, SATELLITES, 4, 0.1).tolist() == [0, 0, 0, 1, 1, -1]
    assert mutual_neighbours(DRONES, SATELLITES, 4, 0.2).tolist() == [0, 0, 0, -1, 1, -1]
    assert mutual_neighbours(DRONES, SATELLITES[:1], 4, 0.2).tolist() == [0, 0, 0, -1, -1, 0]


def test_blocks_change_no_pair(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    drone, satellite = (rng.normal(size=(rows, 8)).astype(np.float32) for rows in (40, 9))
    whole = mutual_neighbours(drone, satellite, 3, 0.05)
    monkeypatch.setattr(pseudo_labels, "BLOCK", 7)
    assert mutual_neighbours(drone, satellite, 3, 0.05).tolist() == whole.tolist()
    assert 0 < (whole != UNPAIRED).sum() < 40


def test_stream_gives_the_pseudo_pairs_and_nothing_else(shards: str) -> None:
    opened = open_shards(shards)
    drones, satellites = (training_keys(opened, view) for view in (View.DRONE, View.SATELLITE))
    satellite_of = {drone: satellites[number % 7] for number, drone in enumerate(drones[:30])}
    labelled = with_pseudo_labels(opened, satellite_of)
    assert labelled.manifest.classes == tuple(satellites)
    samples = [s for one in labelled.manifest.shards for s in labelled.samples(one)]
    assert all(sample.metadata.keys() <= {"location", "sha256"} for sample in samples)
    assert sum(shard.samples for shard in labelled.manifest.of(view=View.DRONE)) == 30
    stream = TrainingStream(labelled, PAIRED)
    assert stream.steps == len(satellites) // 4
    for drone, satellite in (pair for number in range(3) for pair in stream.epoch(number)):
        assert [satellite_of[key] for key in drone.keys] == list(satellite.keys)
        assert [satellites[at] for at in drone.location_B] == list(satellite.keys)
        assert satellite.location_B.tolist() == drone.location_B.tolist()


def test_set_without_pairs_can_be_counted_only(shards: str) -> None:
    hidden = with_pseudo_labels(open_shards(shards), None)
    assert TrainingStream(hidden, PAIRED).steps == 5
    assert hidden.manifest.of(Split.TRAIN, View.DRONE) == open_shards(shards).manifest.of(
        Split.TRAIN, View.DRONE
    )
    assert not [s for one in hidden.manifest.of(view=View.DRONE) for s in hidden.samples(one)]
