"""A training of tiny networks, and comparisons of its weights."""

from typing import Any

import torch
from torch import Tensor

from model.config import LossWeights, Optimization, PVDAConfig
from model.schedule import ScheduleState
from model.training import Training

TINY = PVDAConfig(
    backbone="resnet18",
    width=0.25,
    image_size=64,
    parts=2,
    part_dim=8,
    dropout=0.0,
    discriminator_channels=8,
)
LOCATIONS = 5
NOW = ScheduleState(alpha=0.9, lr_scale=1.0)


def make(
    config: PVDAConfig = TINY,
    optimization: Optimization | None = None,
    adversary: bool = True,
    losses: LossWeights | None = None,
) -> Training:
    torch.manual_seed(0)
    training = Training(
        config, optimization or Optimization(), LOCATIONS, losses=losses, adversary=adversary
    )
    torch.manual_seed(1)  # as the training loop does: dropout does not depend on what was built
    return training


def batch(
    seed: int = 0, drones: int = 3, satellites: int = 3
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """UAV images and their locations, satellite images and theirs."""
    source = torch.Generator().manual_seed(seed)
    drone, satellite = (
        torch.randint(low, low + 150, (count, 3, 64, 64), dtype=torch.uint8, generator=source)
        for count, low in ((drones, 0), (satellites, 100))
    )
    location1_B, location2_B = (
        torch.randint(0, LOCATIONS, (n,), generator=source) for n in (drones, satellites)
    )
    return drone, location1_B, satellite, location2_B


def weights(training: Training) -> dict[str, dict[str, Tensor]]:
    """Parameters of each network, as they are now."""
    return {
        network: {name: parameter.detach().clone() for name, parameter in module.named_parameters()}
        for network, module in training.modules.items()
    }


def changed(before: dict[str, dict[str, Tensor]], after: dict[str, dict[str, Tensor]]) -> set[str]:
    """The networks of which any weight differs."""
    return {
        network
        for network, held in before.items()
        if any(not torch.equal(held[n], after[network][n]) for n in held)
    }


def assert_same(one: Any, other: Any) -> None:
    """Two nested states are equal to the last bit."""
    assert type(one) is type(other)
    if isinstance(one, Tensor):
        assert torch.equal(one, other)
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        for name in one:
            assert_same(one[name], other[name])
    elif isinstance(one, list):
        for mine, its in zip(one, other, strict=True):
            assert_same(mine, its)
    else:
        assert one == other
