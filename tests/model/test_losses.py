"""The paper's equations on logits whose cross-entropies are known by hand.

Logits (ln 3, 0) give the probabilities 3/4 and 1/4, (0, ln 7) give 1/8 and 7/8, (0, 0) give 1/2
each. Shapes: B images, P rings, L locations.
"""

from math import log

import pytest
import torch
from torch import Tensor

from model.losses.pvda import adversarial_loss, feature_loss, location_loss, view_loss

THREE, SEVEN, EVEN = [log(3), 0.0], [0.0, log(7)], [0.0, 0.0]


def labels(*numbers: int) -> Tensor:
    return torch.tensor(numbers)


def test_equation_1_location_loss() -> None:
    drones_BPL = torch.tensor([[THREE, EVEN], [THREE, SEVEN]])
    satellites_BPL = torch.tensor([[SEVEN, SEVEN]])
    found = location_loss(drones_BPL, labels(0, 1), satellites_BPL, labels(0))
    drones = ((log(4 / 3) + log(2)) + (log(4) + log(8 / 7))) / 2
    assert float(found) == pytest.approx(drones + (log(8) + log(8)), rel=1e-6)


def test_equation_2_view_loss() -> None:
    found = view_loss(torch.tensor([THREE]), torch.tensor([SEVEN]))
    assert float(found) == pytest.approx(log(4 / 3) + log(8 / 7), rel=1e-6)


def test_equation_3_adversarial_loss() -> None:
    drones_B2, satellites_B2 = torch.tensor([THREE]), torch.tensor([SEVEN])
    assert float(adversarial_loss(drones_B2, satellites_B2)) == pytest.approx(
        log(4) + log(8), rel=1e-6
    )
    assert float(adversarial_loss(drones_B2, satellites_B2)) == float(
        view_loss(satellites_B2, drones_B2)
    )


def test_equation_4_total_loss() -> None:
    assert float(feature_loss(torch.tensor(3.0), torch.tensor(2.0), alpha=0.9)) == pytest.approx(
        4.8
    )
    assert float(feature_loss(torch.tensor(3.0), torch.tensor(2.0), alpha=0.0)) == 3.0


def test_view_losses_of_undecided_discriminator_are_ln_2() -> None:
    even_B2 = torch.zeros(5, 2)
    for loss in (view_loss, adversarial_loss):
        assert float(loss(even_B2, even_B2)) == pytest.approx(2 * log(2))


def test_view_losses_weigh_both_views_equally() -> None:
    many_B2, one_B2 = torch.tensor([THREE] * 54), torch.tensor([SEVEN])
    for loss in (view_loss, adversarial_loss):
        assert float(loss(many_B2, one_B2)) == pytest.approx(
            float(loss(many_B2[:1], one_B2)), rel=1e-6
        )
    many_BPL, one_BPL = torch.tensor([[THREE, EVEN]] * 54), torch.tensor([[SEVEN, EVEN]])
    many, once = (
        location_loss(many_BPL[:n], labels(*[0] * n), one_BPL, labels(1)) for n in (54, 1)
    )
    assert float(many) == pytest.approx(float(once), rel=1e-6)


def test_swapped_labels_push_hardest_against_certainty() -> None:
    sure_B2 = torch.tensor(
        [[log(9), 0.0]], requires_grad=True
    )  # probabilities .9 and .1; it is a UAV's
    satellite_B2 = torch.zeros(1, 2)
    [swapped_B2] = torch.autograd.grad(adversarial_loss(sure_B2, satellite_B2), sure_B2)
    [straight_B2] = torch.autograd.grad(view_loss(sure_B2, satellite_B2), sure_B2)
    assert swapped_B2[0].tolist() == pytest.approx([0.9, -0.9])
    assert (-straight_B2[0]).tolist() == pytest.approx([0.1, -0.1])
