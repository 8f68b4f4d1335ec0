"""Fixtures of several tests: one Ray for all, a tiny simulated data set, a small encoder."""

import gc
import os
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hypothesis
import pytest
from xdist.scheduler import LoadScopeScheduling

from tests.launcher import ROOT, Launcher, hooked
from tests.processes import Cluster, start_cluster

if TYPE_CHECKING:
    from jobs.region.settings import AdaptSettings
    from model.pvda import FeatureEncoder

# The same for every Ray process that the tests start.
os.environ.setdefault("RAY_AUTH_MODE", "disabled")
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
# Ray Train looks after its workers every 2 s otherwise, and ends that much later.
os.environ.setdefault("RAY_TRAIN_HEALTH_CHECK_INTERVAL_S", "0.5")
# A process of its own per training, for nodes that a cloud takes back.
os.environ.setdefault("RAY_TRAIN_ENABLE_PREEMPTION_WATCHER", "0")
# Its processes take figures for a dashboard that nobody opens, and look after their parent.
os.environ.setdefault("REPORTER_UPDATE_INTERVAL_MS", "60000")
os.environ.setdefault("METRICS_RECORD_INTERVAL_S", "600")
os.environ.setdefault("NODE_STATS_UPDATE_INTERVAL_SECONDS", "600")
os.environ.setdefault("RAY_enable_metrics_collection", "0")
os.environ.setdefault("RAY_task_events_report_interval_ms", "0")
os.environ.setdefault("RAY_enable_pipe_based_agent_to_parent_health_check", "1")
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
    max_examples=50,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
    derandomize="PVDA_FUZZ_EXAMPLES" not in os.environ,
)
hypothesis.settings.load_profile("house")

RAY_FIXTURES = {"ray_session", "ray_cluster"}
"Tests that start Ray ask for one of them."
SLOW_FIXTURES = RAY_FIXTURES | {"prepared", "browser"}
"""Tests that use one of them start Ray, jobs or Chromium: `make test-fast` leaves them out. So it
does with tests/fuzz, and with tests and files that are marked."""
STARTS_RAY = re.compile(r"\bray_(session|cluster|address)\b")
"In a file of tests: it needs the session's Ray."
STARTS = re.compile(rf"{STARTS_RAY.pattern}|\b(prepared|adapted_region)\b")
"It needs that, or the process that starts jobs."
RAY_UNITS = {"training": "tests/jobs/", "other stages": "tests/"}
"""Beginning of such files' names: of several test processes (pytest -n), one runs a unit to its
end, with a Ray and a launcher of its own. Of the others, each file is a unit."""


@cache
def unit_of(file: str) -> str:
    """The name of a file's unit."""
    if not STARTS.search((ROOT / file).read_text()):
        return file
    return next(unit for unit, begin in RAY_UNITS.items() if file.startswith(begin))


def pytest_collection_finish() -> None:
    """What the modules made stays: no collection of garbage goes through it again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        fuzzes = item.nodeid.startswith("tests/fuzz/")
        if fuzzes or SLOW_FIXTURES & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.slow)
    if hasattr(config, "workerinput"):  # a process of pytest-xdist
        items.sort(key=lambda item: turn_of(item.nodeid.partition("::")[0]))


@cache
def turn_of(file: str) -> tuple[bool, bool]:
    """The longest units come first. Two Rays do not start at once: the unit "training" begins with
    what needs none."""
    unit = unit_of(file)
    needs_ray = STARTS_RAY.search((ROOT / file).read_text()) is not None
    return unit not in RAY_UNITS, unit == "training" and needs_ray


class UnitScheduling(LoadScopeScheduling):  # type: ignore[misc]
    """Units instead of files. `--dist loadgroup` would do, but xdist 3.8 finds no groups with
    pytest 9.2.
    """

    def _split_scope(self, nodeid: str) -> str:
        return unit_of(nodeid.partition("::")[0])


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> LoadScopeScheduling:
    return UnitScheduling(config, log)


@pytest.fixture(autouse=True)
def _no_ray_unasked(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if not RAY_FIXTURES & set(request.fixturenames):
        monkeypatch.setattr(
            "pipeline.core.cluster.connect",
            lambda: pytest.fail("starts Ray: ask for the fixture ray_cluster"),
        )


@pytest.fixture(scope="session")
def storage_faults(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file that asks for faults of storage in the session's Ray, see tests/chaos/hook; normally
    there is none.
    """
    return tmp_path_factory.mktemp("faults") / "fault.json"


@pytest.fixture(scope="session")
def ray_session(storage_faults: Path) -> Iterator[Cluster]:
    """A Ray of two cores for all tests of this process."""
    with start_cluster(2, hooked(storage_faults)) as cluster:
        yield cluster


@pytest.fixture(scope="session")
def ray_cluster(ray_session: Cluster) -> Iterator[None]:
    """This process is connected with that Ray."""
    import ray

    from pipeline.core import cluster
    from pipeline.core.errors import Incomplete

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_ADDRESS", ray_session.address)
        for attempt in (1, 2, 3):  # a busy machine exceeds Ray's 30 s now and then
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
def adapted_region(tmp_path_factory: pytest.TempPathFactory, ray_cluster: None) -> "AdaptSettings":
    """A localizer of a town of 400 m, with a moment of training on fewer places than anybody would
    learn from. Beside it lies the town, as benchmarks/region.py arranges them.
    """
    from jobs.region import flights
    from jobs.region.adapt import adapt
    from jobs.region.settings import AdaptSettings
    from pipeline.matching import map_windows, photo_features
    from pipeline.simulation.over_map.settings import TownMapSettings
    from pipeline.simulation.over_map.town_map import MAP, SURFACE, make_town_map

    root = tmp_path_factory.mktemp("adapted")
    town = make_town_map(TownMapSettings(out=str(root / "map"), side=400.0, resolution=0.5))
    settings = AdaptSettings(
        mosaic=str(town / MAP), surface=str(town / SURFACE), out=str(root / "region"),
        minutes=0.01, checks=20, height=(60.0, 80.0), pitch=(-90.0, -75.0), tile_m=(55.0, 110.0),
    )  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flights, "LEAST_PLACES", 24)
        patch.setattr(flights, "TESTED_PLACES", 2)
        patch.setattr(flights, "VIEWS", 1)
        patch.setattr(flights, "CHECK_PX", 256)
        # The town has a pixel each half metre: windows of no more than twice as many.
        patch.setattr(map_windows, "MOST_SIDE_PX", 600)
        patch.setattr(photo_features, "PHOTO_PX", 320)
        adapt(settings)
    return settings


@pytest.fixture(scope="session")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Launcher]:
    """Starts jobs in processes whose libraries are imported already: most of a short job's time."""
    launcher = Launcher(tmp_path_factory.mktemp("launcher"), {})
    yield launcher
    launcher.close()


@pytest.fixture
def ray_address(ray_session: Cluster, ray_cluster: None, monkeypatch: pytest.MonkeyPatch) -> str:
    """The session's Ray, for jobs in separate processes: in their environment."""
    monkeypatch.setenv("RAY_ADDRESS", ray_session.address)
    return ray_session.address


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
