"""The two-step update on networks of a few thousand weights: who moves when, along which gradient,
and how it goes on.

Shapes: B images of a view, C channels of the maps, H x W pixels or cells, L locations.
"""

import copy
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.config import Optimization
from model.losses.pvda import location_loss
from model.schedule import ScheduleState
from model.training import Training
from model.two_views import EncoderWithClassifier
from tests.model.tiny_training import (
    NOW,
    TINY,
    assert_same,
    batch,
    changed,
    make,
    weights,
)

pytestmark = pytest.mark.slow


def watched_step(training: Training) -> list[dict[str, dict[str, Tensor]]]:
    """One iteration; the weights before it, and after each optimiser's step in the order in which
    they came.
    """
    seen = [weights(training)]
    for optimiser in training.optimizers:
        optimiser.register_step_post_hook(lambda *_: seen.append(weights(training)))
    training.step(*batch(), NOW)
    return seen


def test_two_steps_move_disjoint_networks() -> None:
    before, between, after = watched_step(make())
    assert changed(before, between) == {"discriminator"}
    assert changed(between, after) == {"encoder", "classifier"}


def test_discriminator_is_trainable_after_the_step() -> None:
    training = make()
    training.step(*batch(), NOW)
    assert training.discriminator is not None
    assert all(parameter.requires_grad for parameter in training.discriminator.parameters())
    held = weights(training)
    training.step(*batch(1), NOW)
    assert changed(held, weights(training)) == {"encoder", "classifier", "discriminator"}


def reference(
    learner: EncoderWithClassifier, discriminator: nn.Module, alpha: float
) -> dict[str, Tensor]:
    """Gradients of Eq. 4 by autograd, with nothing of the training's own code but the networks and
    Eq. 1.
    """
    images1_B3HW, location1_B, images2_B3HW, location2_B = batch()
    drone, satellite = learner(images1_B3HW, images2_B3HW)
    verdict_B2 = discriminator(torch.cat([drone.maps_BCHW, satellite.maps_BCHW]))
    swapped = F.cross_entropy(verdict_B2[:3], torch.ones(3, dtype=torch.long)) + F.cross_entropy(
        verdict_B2[3:], torch.zeros(3, dtype=torch.long)
    )
    total = (
        location_loss(drone.logits_BPL, location1_B, satellite.logits_BPL, location2_B)
        + alpha * swapped
    )
    names, parameters = zip(*learner.named_parameters(), strict=True)
    return dict(zip(names, torch.autograd.grad(total, parameters), strict=True))


def test_second_step_gradient_is_equation_4() -> None:
    training = make()
    learner = copy.deepcopy(training.model)
    training.step(*batch(), NOW)
    assert training.discriminator is not None
    by_hand = reference(learner, training.discriminator, NOW.alpha)
    for name, parameter in training.model.named_parameters():
        assert parameter.grad is not None
        torch.testing.assert_close(parameter.grad, by_hand[name], rtol=1e-4, atol=1e-6)


def test_second_step_gives_discriminator_no_gradient() -> None:
    training = make()
    seen: list[dict[str, Tensor]] = []

    def gradients(*_: object) -> None:
        assert training.discriminator is not None
        seen.append(
            {
                n: p.grad.clone()
                for n, p in training.discriminator.named_parameters()
                if p.grad is not None
            }
        )

    for optimiser in training.optimizers:
        optimiser.register_step_post_hook(gradients)
    training.step(*batch(), NOW)
    assert seen[0]
    assert_same(seen[0], seen[1])


def test_encoder_gradient_is_of_swapped_labels() -> None:
    adversary, plain = (reference(make().model, _discriminator(), alpha) for alpha in (1.0, 0.0))
    training = make()
    (maps1_BCHW, *_), (maps2_BCHW, *_) = training.model(batch()[0], batch()[2])
    verdict_B2 = _discriminator()(torch.cat([maps1_BCHW, maps2_BCHW]))
    straight = F.cross_entropy(verdict_B2, torch.tensor([0, 0, 0, 1, 1, 1])) * 2
    first = training.model.encoder.backbone.get_parameter("conv1.weight")
    [reversed_gradient] = torch.autograd.grad(-straight, first)
    swapped_gradient = (
        adversary["encoder.backbone.conv1.weight"] - plain["encoder.backbone.conv1.weight"]
    )
    assert not torch.allclose(swapped_gradient, reversed_gradient, rtol=0.05, atol=1e-5)


def _discriminator() -> nn.Module:
    """Of a training just made, its verdicts made surer so that swapping and reversing differ."""
    discriminator = make().discriminator
    assert discriminator is not None
    with torch.no_grad():
        discriminator.verdict.weight *= 20
    return discriminator


def test_discriminator_sees_both_views_twice_per_step() -> None:
    training = make()
    assert training.discriminator is not None
    seen: list[tuple[int, bool, bool]] = []
    training.discriminator.register_forward_pre_hook(
        lambda module, given: seen.append((len(given[0]), module.training, given[0].requires_grad))
    )
    training.step(*batch(), NOW)
    assert seen == [
        (6, True, False),
        (6, True, True),
    ]  # detached from the encoder first, attached to it second


def test_encoder_runs_once_per_view() -> None:
    training = make()
    seen: list[int] = []
    training.model.encoder.register_forward_pre_hook(
        lambda module, given: seen.append(len(given[0]))
    )
    training.step(*batch(), NOW)
    assert seen == [3, 3]


@pytest.mark.parametrize(("drones", "satellites"), [(2, 6), (5, 2)])
def test_step_takes_views_of_different_batch_sizes(drones: int, satellites: int) -> None:
    losses = make().step(*batch(0, drones, satellites), NOW)
    assert all(bool(torch.isfinite(loss)) for loss in losses.values())


@pytest.mark.parametrize("dropout", [0.0, 0.5])
def test_alpha_zero_equals_no_adversary(
    dropout: float,
) -> None:
    config = replace(TINY, dropout=dropout)
    learned = []
    for adversary in (True, False):
        training = make(config, adversary=adversary)
        for seed in range(3):
            training.step(*batch(seed), ScheduleState(alpha=0.0, lr_scale=1.0))
        learned.append(training.model.state_dict())
    assert learned[0].keys() == learned[1].keys()
    for name, tensor in learned[0].items():
        torch.testing.assert_close(tensor, learned[1][name], rtol=1e-5, atol=1e-7)


def test_training_without_adversary_has_no_discriminator() -> None:
    plain = make(adversary=False)
    assert {name.split("/")[0] for name in plain.step(*batch(), NOW)} == {
        "location_loss",
        "gradient_norm",
    }
    assert plain.discriminator is None
    assert len(plain.optimizers) == 1
    assert set(plain.modules) == {"encoder", "classifier"}


def test_alpha_moves_the_encoder_only() -> None:
    gentle, strong = make(), make()
    gentle.step(*batch(), ScheduleState(alpha=0.0, lr_scale=1.0))
    strong.step(*batch(), ScheduleState(alpha=1.0, lr_scale=1.0))
    assert changed(weights(gentle), weights(strong)) == {"encoder"}


def test_step_reports_losses_and_accuracy() -> None:
    training = make()
    measures = training.step(*batch(), NOW)
    whole = {"location_loss", "view_loss", "adversarial_loss", "discriminator_accuracy"}
    assert {name for name in measures if "/" not in name} == whole
    assert not any(measure.requires_grad for measure in measures.values())
    held = Optimization(backbone_lr=0, head_lr=0, classifier_lr=0, discriminator_lr=0.01)
    training = make(optimization=held)
    for _ in range(30):  # the same maps again and again, which D learns by heart
        measures = training.step(*batch(), NOW)
    for name in (
        "discriminator_accuracy",
        "discriminator_accuracy/drone",
        "discriminator_accuracy/satellite",
    ):
        assert float(measures[name]) == 1.0


def test_losses_by_view_and_ring_add_up() -> None:
    measures = {name: float(value) for name, value in make().step(*batch(0, 2, 4), NOW).items()}
    for name in ("location_loss", "view_loss", "adversarial_loss"):
        assert measures[f"{name}/drone"] + measures[f"{name}/satellite"] == pytest.approx(
            measures[name]
        )
    for view in ("drone", "satellite"):
        rings = [measures[f"location_loss/{view}/ring{ring}"] for ring in (1, 2)]
        assert sum(rings) == pytest.approx(measures[f"location_loss/{view}"])
    right = [measures[f"discriminator_accuracy/{view}"] for view in ("drone", "satellite")]
    assert measures["discriminator_accuracy"] == pytest.approx((2 * right[0] + 4 * right[1]) / 6)


def test_step_reports_gradient_norms() -> None:
    training = make()
    measures = training.step(*batch(), NOW)
    for name, module in training.modules.items():
        gradients = [
            parameter.grad for parameter in module.parameters() if parameter.grad is not None
        ]
        length = torch.cat([gradient.flatten() for gradient in gradients]).norm()
        torch.testing.assert_close(measures[f"gradient_norm/{name}"], length, rtol=1e-3, atol=0.0)


def test_training_overfits_repeated_images() -> None:
    training = make()
    first, *_, last = [float(training.step(*batch(), NOW)["location_loss"]) for _ in range(30)]
    assert last < first / 2
