"""Fixtures of several tests: one Ray for all, a tiny simulated data set, a small encoder."""

import os
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hypothesis
import pytest
from xdist.scheduler import LoadScopeScheduling

from tests.launcher import Launcher
from tests.processes import one_start_of_ray

if TYPE_CHECKING:
    from model.pvda import FeatureEncoder

# The same for every Ray process that the tests start.
os.environ.setdefault("RAY_AUTH_MODE", "disabled")
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
# Ray Train looks after its workers every 2 s otherwise, and ends that much later.
os.environ.setdefault("RAY_TRAIN_HEALTH_CHECK_INTERVAL_S", "0.5")
# A process of its own per training, for nodes that a cloud takes back.
os.environ.setdefault("RAY_TRAIN_ENABLE_PREEMPTION_WATCHER", "0")
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
USES_RAY = re.compile(
    r"\b(ray_cluster|ray_address|prepared|workspace|start_cluster|ray job|ray\.init)\b"
)
"""In a file of tests: it starts a cluster of Ray, or jobs that do. Other files may not: each
process that runs some would start one of its own."""
RAY_UNITS = (
    ("tests/chaos/", "tests/core/", "tests/service/", "tests/test_benchmarks.py",
     "tests/jobs/test_signals.py", "tests/jobs/test_submit.py"),
    ("tests/",),
)  # fmt: skip
"""Beginnings of such files' names: of several test processes (pytest -n) each runs one of these
units to its end, then single files of the others."""


@cache
def uses_ray(file: str) -> bool:
    return bool(USES_RAY.search((Path(__file__).parents[1] / file).read_text()))


def unit_of(node: str) -> int:
    """The number of a test's unit; beyond the last one for tests that do not use Ray."""
    file = node.partition("::")[0]
    if not uses_ray(file):
        return len(RAY_UNITS)
    return next(number for number, starts in enumerate(RAY_UNITS) if file.startswith(starts))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        if SLOW_FIXTURES & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.slow)
    if hasattr(config, "workerinput"):  # a process of pytest-xdist
        items.sort(key=lambda item: unit_of(item.nodeid))


class RayUnitScheduling(LoadScopeScheduling):  # type: ignore[misc]
    """A unit of RAY_UNITS is one piece of work, of the other tests each file is one.

    `--dist loadgroup` would do, but xdist 3.8 finds no groups with pytest 9.2.
    """

    def _split_scope(self, nodeid: str) -> str:
        unit = unit_of(nodeid)
        file: str = nodeid.partition("::")[0]
        return f"Ray {unit}" if unit < len(RAY_UNITS) else file


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> LoadScopeScheduling:
    return RayUnitScheduling(config, log)


@pytest.fixture(autouse=True)
def _no_ray_in_other_files(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if not uses_ray(request.node.nodeid.partition("::")[0]):
        monkeypatch.setattr(
            "pipeline.core.cluster.connect",
            lambda: pytest.fail("starts Ray: ask for the fixture ray_cluster"),
        )


@pytest.fixture(scope="session")
def ray_cluster() -> Iterator[None]:
    """A local Ray of this test session, or of this process of several.

    Ray gives itself 30 s to start, which a busy machine exceeds now and then: tried three times.
    """
    import ray

    from pipeline.core import cluster
    from pipeline.core.errors import Incomplete

    with one_start_of_ray():
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
def tiny_world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """University-1652's layout: 6 training and 3 test locations, 2 distractors, 3 views each."""
    from pipeline.simulation.settings import SimulationSettings
    from pipeline.simulation.simulate import simulate

    out = tmp_path_factory.mktemp("world")
    return simulate(
        SimulationSettings(
            out=str(out),
            train_locations=6,
            test_locations=3,
            distractors=2,
            views=3,
            size=64,
            workers=0,
        )
    )


@pytest.fixture(scope="session")
def tiny_shards(tmp_path_factory: pytest.TempPathFactory, tiny_world: Path) -> str:
    """That data set as shards of 8 images."""
    from pipeline.shards.pack import pack
    from pipeline.shards.settings import PackingSettings
    from pipeline.sources.university1652 import University1652

    out = str(tmp_path_factory.mktemp("shards"))
    settings = PackingSettings(root=str(tiny_world), out=out, samples_per_shard=8, workers=0)
    pack(University1652(), settings)
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
