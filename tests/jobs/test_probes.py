"""What the probes say of features made here, and that looking changes nothing."""

from dataclasses import replace
from itertools import count

import numpy as np
import pytest
import torch

from jobs.training.probes import embed_view, probe, view_gap
from jobs.training.recipes.pvda import smoke
from model.pvda import FeatureEncoder
from pipeline.batches.settings import StreamConfig
from pipeline.batches.training import TrainingStream
from pipeline.core.arrays import Floats, Pixels
from pipeline.core.errors import InputError
from pipeline.core.records import View
from pipeline.images.decode import DecodeError, decode
from pipeline.shards.shard_set import open_shards


def features(shift: float, count: int = 80, channels: int = 40) -> tuple[Floats, Floats]:
    """Two views of unit noise in every channel, one of them shifted along the first."""
    rng = np.random.default_rng(0)
    drone, satellite = rng.standard_normal((2, count, channels)).astype(np.float32)
    satellite[:, 0] += shift
    return drone, satellite


def test_view_gap_of_equal_views_is_zero() -> None:
    gap = view_gap(*features(0.0))
    assert 0.35 < gap["view_gap/accuracy"] < 0.65
    assert gap["view_gap/distance"] < 0.3


def test_view_gap_measures_a_shift() -> None:
    gap = view_gap(*features(6.0))
    assert gap["view_gap/accuracy"] > 0.95
    assert gap["view_gap/distance"] == pytest.approx(6 / 40**0.5, rel=0.1)


def test_view_gap_is_independent_of_scale() -> None:
    drone, satellite = features(1.0)
    drone[:, 7] = satellite[:, 7] = 3.0
    once, again = view_gap(drone, satellite), view_gap(drone * 100, satellite * 100)
    assert once["view_gap/accuracy"] == again["view_gap/accuracy"]
    assert once["view_gap/distance"] == pytest.approx(again["view_gap/distance"], rel=1e-4)


def test_view_gap_takes_equal_counts_of_both_views() -> None:
    drone, satellite = features(6.0)
    assert view_gap(drone, satellite[:21]) == view_gap(drone[:21], satellite[:21])


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_probe_leaves_the_encoder_unchanged(tiny_shards: str, share: float) -> None:
    torch.manual_seed(0)
    encoder = FeatureEncoder(replace(smoke().network, part_dim=16)).train()
    before = {name: tensor.clone() for name, tensor in encoder.state_dict().items()}
    stream = TrainingStream(
        open_shards(tiny_shards), StreamConfig(batch_size=2, image_size=64, hold_out=share)
    )
    found = probe(encoder, stream)
    assert encoder.training
    assert all(torch.equal(before[name], tensor) for name, tensor in encoder.state_dict().items())
    names = {"view_gap/accuracy", "view_gap/distance"}
    if share:
        tasks = ("drone_to_satellite", "satellite_to_drone")
        names |= {f"held_out/{task}/{measure}" for task in tasks for measure in ("r1", "ap")}
    assert set(found) == names
    assert all(value >= 0 for value in found.values())
    assert found == probe(encoder, stream)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_probe_skips_damaged_images(
    tiny_shards: str, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoder = FeatureEncoder(replace(smoke().network, part_dim=16))
    stream = TrainingStream(
        open_shards(tiny_shards),
        StreamConfig(batch_size=2, image_size=64, hold_out=share, threads=1),
    )
    whole = embed_view(encoder, stream, View.DRONE)
    drawn, every = count(), 2

    def failing(data: bytes) -> Pixels:
        if next(drawn) % every == 0:
            raise DecodeError("damaged image", "here")
        return decode(data)

    monkeypatch.setattr("pipeline.batches.ordered.decode", failing)
    found = embed_view(encoder, stream, View.DRONE)
    assert found.locations == whole.locations[1::2]
    assert np.allclose(found.pooled_NC, whole.pooled_NC[1::2], atol=1e-5)
    every = 1
    with pytest.raises(InputError, match="not one drone image"):
        embed_view(encoder, stream, View.DRONE)
