"""InfoNCE against torch's cross-entropy, and on embeddings whose loss is known by hand."""

from math import exp, log

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from model.config import LossWeights
from model.losses.contrastive import info_nce
from model.schedule import ScheduleState
from tests.model.tiny_training import batch, make


def unit(count: int, seed: int) -> Tensor:
    return F.normalize(torch.randn(count, 8, generator=torch.Generator().manual_seed(seed)), dim=1)


def test_info_nce_orthogonal_pairs_by_hand() -> None:
    eye = torch.eye(2)
    found = info_nce(eye, eye, torch.tensor([3, 7]), temperature=1.0, label_smoothing=0.0)
    assert float(found) == pytest.approx(log(exp(1) + 1) - 1, rel=1e-6)


@pytest.mark.parametrize("smoothing", [0.0, 0.1])
def test_info_nce_is_symmetric_cross_entropy(smoothing: float) -> None:
    drone, satellite, rows = unit(6, 0), unit(6, 1), torch.arange(6)
    logits = drone @ satellite.T / 0.05
    expected = sum(F.cross_entropy(side, rows, label_smoothing=smoothing) for side in
                   (logits, logits.T)) / 2  # fmt: skip
    torch.testing.assert_close(info_nce(drone, satellite, rows, 0.05, smoothing), expected)
    torch.testing.assert_close(info_nce(satellite, drone, rows, 0.05, smoothing), expected)


def test_info_nce_leaves_out_rows_of_the_same_location() -> None:
    drone, satellite = unit(3, 0), unit(3, 1)
    drone[2], satellite[2] = drone[0], satellite[0]
    twice = info_nce(drone, satellite, torch.tensor([4, 5, 4]), 0.1, 0.1)
    once = [info_nce(drone[:2], satellite[:2], torch.tensor([4, 5]), 0.1, 0.1)]
    # Rows 0 and 2 compare with row 1 alone, row 1 with both copies: only its sum has a term more.
    logits = drone @ satellite.T / 0.1
    row1 = [F.cross_entropy(side[1:2], torch.tensor([1]), label_smoothing=0.1) for side in
            (logits, logits.T)]  # fmt: skip
    pair = [F.cross_entropy(side[:2, :2][:1], torch.tensor([0]), label_smoothing=0.1) for side in
            (logits, logits.T)]  # fmt: skip
    torch.testing.assert_close(twice, sum((2 * p + r) / 3 for p, r in zip(pair, row1, strict=True))
                               / 2)  # fmt: skip
    assert not torch.isclose(twice, once[0])
    drone.requires_grad_()
    loss = info_nce(drone, satellite, torch.tensor([4, 5, 4]), 0.1, 0.1)
    loss.backward()  # type: ignore[no-untyped-call]
    assert drone.grad is not None
    assert torch.isfinite(drone.grad).all()


def test_training_adds_info_nce_by_its_weight() -> None:
    now = ScheduleState(alpha=0.0, lr_scale=1.0)
    images1, locations, images2, _ = batch()
    plain = make(adversary=False)
    paired = make(adversary=False, losses=LossWeights(contrastive_weight=2.0))
    both = (images1[:2], locations[:2], images2[:2], locations[:2])
    without, found = plain.step(*both, now), paired.step(*both, now)
    assert "contrastive_loss" not in without
    assert float(found["location_loss"]) == float(without["location_loss"])
    assert float(found["contrastive_loss"]) > 0
    assert float(found["gradient_norm/encoder"]) != float(without["gradient_norm/encoder"])


def test_loss_weights_refuse_nothing_to_learn() -> None:
    with pytest.raises(ValueError, match="the weights of all losses are 0, expected one above 0"):
        LossWeights(location_weight=0.0)
    with pytest.raises(ValueError, match="temperature is 0"):
        LossWeights(temperature=0.0)
