"""Fixtures of several tests: one Ray for all, a tiny simulated data set, a small encoder."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import hypothesis
import pytest

from tests.launcher import Launcher

if TYPE_CHECKING:
    from model.pvda import FeatureEncoder

# The same for every Ray process that the tests start.
os.environ.setdefault("RAY_AUTH_MODE", "disabled")
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
# Ray Train looks after its workers every 2 s otherwise, and ends that much later.
os.environ.setdefault("RAY_TRAIN_HEALTH_CHECK_INTERVAL_S", "0.5")
# Never a cluster that someone, or another test, runs on this machine.
os.environ["RAY_ADDRESS"] = "local"
# Waiting threads yield their core: on a busy machine, a spinning thread takes it from the thread
# that it waits for.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# The same examples each time, and no deadline: a pause of the machine is no defect.
# PVDA_FUZZ_EXAMPLES tries others.
hypothesis.settings.register_profile(
    "house",
    deadline=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
    derandomize="PVDA_FUZZ_EXAMPLES" not in os.environ,
)
hypothesis.settings.load_profile("house")

SLOW_FIXTURES = {"ray_cluster", "prepared", "browser", "workspace"}
"Tests that use one of them start Ray, jobs or Chromium: `make test-fast` leaves them out."
LONGEST = (
    "tests/chaos/test_chaos.py",
    "tests/test_benchmarks.py",
    "tests/jobs/test_submit.py",
    "tests/jobs/test_checkpoints.py",
    "tests/jobs/test_ray_group.py",
    "tests/jobs/test_jobs.py",
    "tests/service/test_serve.py",
)
"Files that several test processes (pytest -n) begin with, so that none ends with one of them."


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        if SLOW_FIXTURES & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.slow)
    if hasattr(config, "workerinput"):  # a process of pytest-xdist
        order = {file: number for number, file in enumerate(LONGEST)}
        items.sort(key=lambda item: order.get(item.nodeid.partition("::")[0], len(order)))


@pytest.fixture(scope="session")
def ray_cluster() -> Iterator[None]:
    """A local Ray of this test session, or of this process of several.

    Ray gives itself 30 s to start, which a busy machine exceeds now and then: tried three times.
    """
    import ray

    from pipeline.core import cluster
    from pipeline.core.errors import Incomplete

    for attempt in (1, 2, 3):
        try:
            cluster.connect()
            break
        except Incomplete:
            ray.shutdown()
            if attempt == 3:
                raise
    yield
    ray.shutdown()


@pytest.fixture(scope="session")
def tiny_world(tmp_path_factory: pytest.TempPathFactory, ray_cluster: None) -> Path:
    """University-1652's layout: 6 training and 3 test locations, 2 distractors, 3 views each."""
    from pipeline.simulation.settings import SimulationSettings
    from pipeline.simulation.simulate import simulate

    out = tmp_path_factory.mktemp("world")
    return simulate(
        SimulationSettings(
            out=str(out), train_locations=6, test_locations=3, distractors=2, views=3, size=64
        )
    )


@pytest.fixture(scope="session")
def tiny_shards(tmp_path_factory: pytest.TempPathFactory, tiny_world: Path) -> str:
    """That data set as shards of 8 images."""
    from pipeline.shards.pack import pack
    from pipeline.shards.settings import PackingSettings
    from pipeline.sources.university1652 import University1652

    out = str(tmp_path_factory.mktemp("shards"))
    pack(University1652(), PackingSettings(root=str(tiny_world), out=out, samples_per_shard=8))
    return out


@pytest.fixture(scope="session")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Launcher]:
    """Starts jobs in processes whose libraries are imported already: most of a short job's time."""
    launcher = Launcher(tmp_path_factory.mktemp("launcher"), {})
    yield launcher
    launcher.close()


@pytest.fixture
def ray_address(ray_cluster: None, monkeypatch: pytest.MonkeyPatch) -> str:
    """The session's Ray, for jobs in separate processes: in their environment."""
    import ray

    address: str = ray.get_runtime_context().gcs_address
    monkeypatch.setenv("RAY_ADDRESS", address)
    return address


def make_lively_encoder() -> "FeatureEncoder":
    """A ResNet-18 of a quarter's width at 64 px with BatchNorms that change its output."""
    import torch
    from torch import nn

    from model.config import PVDAConfig
    from model.pvda import FeatureEncoder

    torch.manual_seed(0)
    encoder = FeatureEncoder(
        PVDAConfig(backbone="resnet18", width=0.25, image_size=64, parts=2, part_dim=16)
    ).eval()
    with torch.no_grad():
        for module in encoder.modules():
            if isinstance(module, nn.modules.batchnorm._BatchNorm):
                assert module.running_mean is not None
                assert module.running_var is not None
                module.running_mean.normal_(0, 0.3)
                module.running_var.uniform_(0.3, 2)
                module.weight.uniform_(0.5, 1.5)
                module.bias.normal_(0, 0.3)
    return encoder


@pytest.fixture
def lively_encoder() -> "FeatureEncoder":
    """A new one for each test: `make_lively_encoder`."""
    return make_lively_encoder()
