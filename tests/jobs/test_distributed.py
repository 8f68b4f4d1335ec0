"""Two workers compute what one computes on their images together: gradients of two processes
against one's.

BatchNorm's statistics are apart: each worker has its own unless `sync_bn` joins them on GPUs, so
they are frozen here.
"""

import socket
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from torch.multiprocessing import (  # type: ignore[attr-defined]
    set_forkserver_preload,
    start_processes,
)

from jobs.training.ray_group import broadcast_from_first, wrap_ddp
from model.checkpoint import Checkpoint
from model.config import Optimization, PVDAConfig
from model.schedule import ScheduleState
from model.training import Training

pytestmark = pytest.mark.slow

CONFIG = PVDAConfig(
    backbone="resnet18",
    width=0.25,
    image_size=64,
    parts=2,
    part_dim=8,
    dropout=0.0,
    discriminator_channels=16,
)
STILL = ScheduleState(alpha=0.9, lr_scale=0.0)
"""Rates of zero: gradients are computed and nothing moves, so D's first Adam step cannot blow up a
last bit."""
WORKERS, EACH, LOCATIONS = 2, 3, 5


def frozen(training: Training) -> Training:
    for module in training.modules.values():
        for layer in module.modules():
            if isinstance(layer, nn.BatchNorm1d | nn.BatchNorm2d):
                layer.eval()
    return training


def batch() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The images of all workers."""
    source, count = torch.Generator().manual_seed(0), WORKERS * EACH
    views = [
        torch.randint(0, 256, (count, 3, 64, 64), dtype=torch.uint8, generator=source)
        for _ in range(2)
    ]
    labels = [torch.randint(0, LOCATIONS, (count,), generator=source) for _ in range(2)]
    return views[0], labels[0], views[1], labels[1]


def gradients(training: Training) -> dict[str, Tensor]:
    return {
        f"{network}.{name}": parameter.grad
        for network, module in training.modules.items()
        for name, parameter in module.named_parameters()
        if parameter.grad is not None
    }


def checkpoint(epoch: int) -> Checkpoint:
    return Checkpoint(
        network=CONFIG, recipe={}, locations=[], epoch=epoch, history=[], state={"modules": {}}
    )


def work(rank: int, port: int, out: str) -> None:
    torch.set_num_threads(1)
    address = f"tcp://127.0.0.1:{port}"
    torch.distributed.init_process_group("gloo", init_method=address, rank=rank, world_size=WORKERS)
    torch.manual_seed(rank)  # DDP gives all workers the weights of rank 0
    training = frozen(Training(CONFIG, Optimization(), LOCATIONS, wrap_ddp=wrap_ddp))
    drone, location1_B, satellite, location2_B = (
        tensor[rank * EACH : (rank + 1) * EACH] for tensor in batch()
    )
    for _ in range(2):  # a second step: nothing of the first one's bookkeeping is left over
        training.step(drone, location1_B, satellite, location2_B, STILL)
    found = broadcast_from_first(("last.pt", checkpoint(epoch=7)) if rank == 0 else None)
    assert found is not None
    torch.save((gradients(training), found[1].epoch), f"{out}/{rank}.pt")
    torch.distributed.destroy_process_group()


def test_two_workers_have_the_gradients_of_one(
    tmp_path: Path,
) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
    set_forkserver_preload([__name__])  # imports it once for both
    start_processes(  # type: ignore[no-untyped-call]
        work, (port, str(tmp_path)), WORKERS, start_method="forkserver"
    )
    torch.manual_seed(0)
    alone = frozen(Training(CONFIG, Optimization(), LOCATIONS))
    for _ in range(2):
        alone.step(*batch(), STILL)
    wanted = gradients(alone)
    assert {name.split(".")[0] for name in wanted} == {"encoder", "classifier", "discriminator"}
    for rank in range(WORKERS):
        found, epoch = torch.load(tmp_path / f"{rank}.pt", weights_only=True)
        assert epoch == 7
        assert found.keys() == wanted.keys()
        for name, gradient in wanted.items():
            torch.testing.assert_close(
                found[name], gradient, rtol=1e-3, atol=1e-5, msg=f"{name} of rank {rank}"
            )
