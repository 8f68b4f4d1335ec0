"""Optimizers, precision, compilation, BatchNorm over both views, and the state of a training."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.optim import SGD, Adam, AdamW

from model.checkpoint import Checkpoint, dumps, loads
from model.config import Optimization
from model.schedule import ScheduleState
from model.training import Training
from model.two_views import EncoderWithClassifier
from tests.model.tiny_training import LOCATIONS, NOW, TINY, assert_same, batch, make

pytestmark = pytest.mark.slow


def test_step_scales_each_groups_rate() -> None:
    training = make()
    training.step(*batch(), ScheduleState(alpha=0.9, lr_scale=0.8))
    assert training.learning_rates == pytest.approx(
        {"backbone": 0.0008, "head": 0.008, "classifier": 0.008, "discriminator": 0.0016}
    )
    assert {len(g["params"]) for g in training.optimizers[0].param_groups} == {60, 2 * 4, 2 * 2}


def test_optimizers_are_sgd_or_adamw() -> None:
    of_encoder, of_discriminator = make().optimizers
    assert type(of_encoder) is SGD
    assert type(of_discriminator) is Adam
    for group in of_encoder.param_groups:
        assert (group["momentum"], group["nesterov"], group["weight_decay"]) == (0.9, True, 5e-4)
    [group] = of_discriminator.param_groups
    assert (group["betas"], group["weight_decay"]) == ((0.9, 0.999), 0)
    assert type(make(optimization=Optimization(optimizer="adamw")).optimizers[0]) is AdamW


def test_step_in_bfloat16_keeps_float32_weights() -> None:
    torch.manual_seed(0)
    half = Training(TINY, Optimization(), LOCATIONS, precision="bfloat16")
    whole = make()
    rough, exact = half.step(*batch(), NOW), whole.step(*batch(), NOW)
    assert {measure.dtype for measure in rough.values()} == {torch.float32}
    assert {parameter.dtype for parameter in half.model.parameters()} == {torch.float32}
    assert float(rough["location_loss"]) == pytest.approx(float(exact["location_loss"]), rel=0.05)
    assert rough["location_loss"] != exact["location_loss"]
    assert not Training(TINY, Optimization(), LOCATIONS, precision="auto").bfloat16  # on a CPU


def test_compile_failure_keeps_networks_and_reports(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def broken(self: nn.Module) -> None:
        def fail(*_: Tensor) -> None:
            self.encoder.backbone.bn1.running_mean.add_(1)  # type: ignore[union-attr, operator]
            raise RuntimeError("no C++ compiler\nand a long story")

        self._compiled_call_impl = fail

    monkeypatch.setattr(nn.Module, "compile", broken)
    torch.manual_seed(0)
    uncompiled = Training(TINY, Optimization(), LOCATIONS, compile_for=3)
    assert uncompiled.compile_error == "RuntimeError: no C++ compiler"
    plain = make()
    assert plain.compile_error is None
    torch.manual_seed(1)
    uncompiled.step(*batch(), NOW)
    plain.step(*batch(), NOW)
    assert_same(uncompiled.state_dict(), plain.state_dict())


@pytest.mark.parametrize("kind", ["sgd", "adamw"])
def test_training_state_resumes_bit_by_bit(kind: Any) -> None:
    config, optimization = replace(TINY, dropout=0.5), Optimization(optimizer=kind)
    whole = make(config, optimization)
    for seed in range(2):
        whole.step(*batch(seed), NOW)
    held = Checkpoint(
        network=config, recipe={}, locations=[], epoch=1, history=[], state=whole.state_dict()
    )
    data = dumps(held)
    for seed in range(2, 4):
        whole.step(*batch(seed), NOW)

    torch.manual_seed(99)
    resumed = Training(config, optimization, LOCATIONS)
    resumed.load_state_dict(loads(data).state)
    for seed in range(2, 4):
        resumed.step(*batch(seed), NOW)
    assert_same(resumed.state_dict(), whole.state_dict())


def test_load_state_rejects_another_adversary() -> None:
    with pytest.raises(KeyError, match="discriminator"):
        make().load_state_dict(make(adversary=False).state_dict())


def test_joint_bn_encodes_both_views_in_one_batch() -> None:
    torch.manual_seed(0)
    learner = EncoderWithClassifier(TINY, 3, joint_bn=True)
    images_B3HW = torch.randint(0, 256, (5, 3, 64, 64), dtype=torch.uint8)
    (maps1, g1, _, logits1), (maps2, g2, _, logits2) = learner(images_B3HW[:2], images_B3HW[2:])
    maps_BCHW, g_BPD = learner.encoder(images_B3HW)
    assert torch.equal(torch.cat([maps1, maps2]), maps_BCHW)
    assert torch.equal(torch.cat([g1, g2]), g_BPD)
    assert torch.allclose(torch.cat([logits1, logits2]), learner.classifier(g_BPD))
    apart = EncoderWithClassifier(TINY, 3)
    apart.load_state_dict(learner.state_dict())
    assert not torch.allclose(
        apart(images_B3HW[:2], images_B3HW[2:])[0].maps_BCHW, maps1, atol=1e-3
    )
