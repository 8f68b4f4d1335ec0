"""Where a campaign runs its stages: intact folders, a scratch folder to damage, a Ray cluster."""

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.chaos.faults import STORAGE
from tests.chaos.stages import IN_PROCESS, Content, Stage
from tests.launcher import JobResult, Launcher, RunningJob, hooked
from tests.processes import Cluster, busy_workers, ray_daemons, start_cluster

TIMEOUT_S = 180.0
"A run counts as hung after this plus ten times an undisturbed run's duration."

WORKER_STARTS_S = 1.0
"Added to a stage's duration in one process, for a guess of that with Ray's workers."


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """The outcome of a stage's run without faults."""

    content: Content
    operations: Mapping[str, int]
    "File operations by kind."


class Workspace:
    """Runs stages in `folder`, which faults may damage, and keeps intact copies beside it."""

    def __init__(
        self,
        scratch: Path,
        cluster: Cluster,
        fault: Path,
        environment: Mapping[str, str],
        quick: Launcher | None = None,
    ) -> None:
        """`fault`: the file that CHAOS names in the processes of the cluster.

        `quick`: starts the jobs, and a stage that can run in one process always does; how long it
        takes with Ray's workers is not measured.
        """
        self.quick = quick is not None
        self.folder, self._intact = scratch / "here", scratch / "pristine"
        self._fault, self._counter = fault, scratch / "operations"
        self._environment = {**environment, "CHAOS": str(fault)}
        self._launcher = quick or Launcher(scratch, self._environment)
        self._cluster = cluster
        self._others = set[int]()
        "Busy workers of the cluster that are none of the job's that runs."
        self._baselines: dict[str, Baseline] = {}
        self._seconds: dict[tuple[str, bool], float] = {}

    def close(self) -> None:
        if not self.quick:  # otherwise it is the caller's
            self._launcher.close()

    def prepare(self, stage: Stage, with_output: bool = False) -> None:
        """Copy a stage's intact inputs, and its finished output if asked, to a fresh folder."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        self._fault.unlink(missing_ok=True)
        for name in (*stage.reads, *([stage.writes] if with_output else [])):
            _copy_with_lists(self._intact, self.folder, name)

    def start(
        self, stage: Stage, distributed: bool, own_cluster: bool = False, verified: bool = False
    ) -> RunningJob:
        self._others = set(busy_workers(self._cluster.pid))
        address = "local" if own_cluster else self._cluster.address
        command = stage.command(self.folder, distributed, verified)
        return self._start(stage.job, command, address)

    def run(self, stage: Stage, distributed: bool, verified: bool = False) -> JobResult:
        return self.start(stage, distributed, verified=verified).end(self.timeout_s(stage))

    def timeout_s(self, stage: Stage) -> float:
        known = [seconds for (name, _), seconds in self._seconds.items() if name == stage.name]
        return TIMEOUT_S + 10 * max(known, default=0.0)

    def verify_output(self, stage: Stage) -> JobResult:
        """Run the stage's own check of every byte that it wrote."""
        assert stage.verify_output
        where = IN_PROCESS if self.quick else ""
        words = f"{stage.verify_output} {where}".format(here=self.folder).split()
        return self._start(stage.job, words, self._cluster.address).end(self.timeout_s(stage))

    def _start(self, job: str, words: list[str], address: str) -> RunningJob:
        return self._launcher.start(job, words, **self._environment, RAY_ADDRESS=address)

    def victims(self, job: RunningJob, kind: str) -> list[int]:
        """Processes that a kill of this kind may hit."""
        if kind.startswith("driver"):
            return [job.pid]
        if kind.startswith("cluster"):
            return ray_daemons(job.pid)
        workers = busy_workers(self._cluster.pid) + busy_workers(job.pid)
        return [worker for worker in workers if worker not in self._others]

    def arm(self, kind: str, at: int) -> None:
        """Let the file operation of number `at` meet a fault; -1: only count operations."""
        self.disarm()
        for counter in self._counter.parent.glob(f"{self._counter.name}.*"):
            counter.unlink()
        fault = {
            "kind": kind,
            "operation": STORAGE[kind],
            "at": at,
            "under": str(self.folder),
            "counter": str(self._counter),
        }
        self._fault.write_text(json.dumps(fault))

    def disarm(self) -> dict[str, int]:
        """End the storage faults; the number of operations since `arm`, by kind."""
        self._fault.unlink(missing_ok=True)
        counters = {kind: Path(f"{self._counter}.{kind}") for kind in ("read", "write")}
        return {
            kind: path.stat().st_size if path.exists() else 0 for kind, path in counters.items()
        }

    def seconds(self, stage: Stage, distributed: bool) -> float:
        """The stage's undisturbed duration; measured on first use."""
        if distributed and self.quick:  # a worker starts and imports for as long at least
            return self.seconds(stage, distributed=False) + WORKER_STARTS_S
        if (stage.name, distributed) not in self._seconds:
            self.prepare(stage)
            self._seconds[stage.name, distributed] = self._complete(stage, distributed)
            self.prepare(stage)
        return self._seconds[stage.name, distributed]

    def _complete(self, stage: Stage, distributed: bool) -> float:
        result = self.run(stage, distributed)
        if result.code != 0:
            raise RuntimeError(f"{stage.name} fails without faults: {result.output[-2000:]}")
        return result.seconds

    def baseline(self, stage: Stage) -> Baseline:
        """Run the stage without faults, once; its output is the input of later stages."""
        if stage.name not in self._baselines:
            self.prepare(stage)
            self.arm("read fails", -1)
            self._seconds[stage.name, False] = self._complete(stage, distributed=False)
            operations, content = self.disarm(), stage.read_content(self.folder)
            _copy_with_lists(self.folder, self._intact, stage.writes)
            self._baselines[stage.name] = Baseline(content=content, operations=operations)
        return self._baselines[stage.name]


def _copy_with_lists(source: Path, target: Path, name: str) -> None:
    """Copy a folder, and the files beside it that are named after it."""
    shutil.copytree(source / name, target / name)
    for path in source.glob(f"{name}.*"):
        shutil.copy(path, target)


ENVIRONMENT = {
    "RAY_AUTH_MODE": "disabled",
    "RAY_USAGE_STATS_ENABLED": "0",
    "OMP_WAIT_POLICY": "PASSIVE",
    # Ray gives a lost cluster up after a minute otherwise.
    "RAY_gcs_rpc_server_reconnect_timeout_s": "5",
}


@contextmanager
def open_workspace(scratch: Path) -> Iterator[Workspace]:
    """A workspace in an emptied folder, with a Ray cluster of its own."""
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    scratch = scratch.resolve()
    fault = scratch / "fault.json"
    with start_cluster(2, ENVIRONMENT | hooked(fault)) as cluster:
        workspace = Workspace(scratch, cluster, fault, ENVIRONMENT)
        try:
            yield workspace
        finally:
            workspace.close()
