"""Where the stages of a campaign run: their folders as they should be, the one that is spoilt, and
a Ray cluster of its own.
"""

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.chaos.faults import STORAGE
from tests.chaos.stages import Content, Stage
from tests.launcher import PATH, Ended, Job, Launcher
from tests.processes import cluster, daemons, working

PATIENCE = 180.0
"Seconds, and ten times as long as an undisturbed run, after which a run counts as hung."


@dataclass(frozen=True, kw_only=True)
class Undisturbed:
    """A stage's run without faults."""

    content: Content
    operations: Mapping[str, int]
    "On files, by kind."


class Ground:
    """Where the stages run: the folders as they should be, and the one that is spoilt."""

    def __init__(
        self,
        scratch: Path,
        environment: Mapping[str, str],
        head: int,
        address: str,
        quick: bool = False,
    ) -> None:
        """`head`: process above the Ray cluster at `address`. `quick`: one process does what one
        can do.
        """
        self.quick = quick
        self.here, self._pristine = scratch / "here", scratch / "pristine"
        self._spec, self._counter = scratch / "fault.json", scratch / "operations"
        self._launcher = Launcher(scratch, {**environment, "CHAOS": str(self._spec)})
        self._head, self._address = head, address
        self._known: dict[str, Undisturbed] = {}
        self._seconds: dict[tuple[str, bool], float] = {}

    def close(self) -> None:
        self._launcher.close()

    def prepare(self, stage: Stage, without: bool = True) -> None:
        """Lay out what a stage reads, and nothing else."""
        shutil.rmtree(self.here, ignore_errors=True)
        self.here.mkdir(parents=True)
        self._spec.unlink(missing_ok=True)
        for name in (*stage.reads, *([] if without else [stage.writes])):
            shutil.copytree(self._pristine / name, self.here / name)

    def start(
        self, stage: Stage, spread: bool, own_cluster: bool = False, guarded: bool = False
    ) -> Job:
        address = "local" if own_cluster else self._address
        return self._launcher.start(
            stage.job, stage.command(self.here, spread, guarded), RAY_ADDRESS=address
        )

    def run(self, stage: Stage, spread: bool, guarded: bool = False) -> Ended:
        return self.start(stage, spread, guarded=guarded).end(self.patience(stage))

    def patience(self, stage: Stage) -> float:
        known = [seconds for (name, _), seconds in self._seconds.items() if name == stage.name]
        return PATIENCE + 10 * max(known, default=0.0)

    def check(self, stage: Stage) -> Ended:
        """The stage's own check of every byte that it wrote."""
        assert stage.verify
        words = stage.verify.format(here=self.here).split()
        return self._launcher.start(stage.job, words, RAY_ADDRESS=self._address).end(
            self.patience(stage)
        )

    def victims(self, job: Job, kind: str) -> list[int]:
        """Who may be killed."""
        if kind.startswith("driver"):
            return [job.pid]
        return (
            daemons(job.pid)
            if kind.startswith("cluster")
            else working(self._head) + working(job.pid)
        )

    def arm(self, kind: str, at: int) -> None:
        """The operation on files with this number meets a fault."""
        self.disarm()
        for counter in self._counter.parent.glob(f"{self._counter.name}.*"):
            counter.unlink()
        said = {
            "kind": kind,
            "operation": STORAGE[kind],
            "at": at,
            "under": str(self.here),
            "counter": str(self._counter),
        }
        self._spec.write_text(json.dumps(said))

    def disarm(self) -> dict[str, int]:
        """No more faults; how many operations there were, by their kind."""
        self._spec.unlink(missing_ok=True)
        counters = {
            name: self._counter.with_name(f"{self._counter.name}.{name}")
            for name in ("read", "write")
        }
        return {
            name: path.stat().st_size if path.exists() else 0 for name, path in counters.items()
        }

    def seconds(self, stage: Stage, spread: bool) -> float:
        """How long the stage takes undisturbed; measured when first asked."""
        spread = spread and bool(stage.alone)  # else Ray's workers do it in any case
        if (stage.name, spread) not in self._seconds:
            self.prepare(stage)
            self._seconds[stage.name, spread] = self._done(stage, spread)
            self.prepare(stage)
        return self._seconds[stage.name, spread]

    def _done(self, stage: Stage, spread: bool) -> float:
        ended = self.run(stage, spread)
        if ended.code != 0:
            raise RuntimeError(f"{stage.name} does not run undisturbed: {ended.said[-2000:]}")
        return ended.seconds

    def undisturbed(self, stage: Stage) -> Undisturbed:
        """How the stage runs without faults, and its content, which the stages after it read."""
        if stage.name not in self._known:
            self.prepare(stage)
            self.arm("read fails", -1)
            self._seconds[stage.name, False] = self._done(stage, spread=False)
            operations, content = self.disarm(), stage.held(self.here)
            shutil.copytree(self.here / stage.writes, self._pristine / stage.writes)
            self._known[stage.name] = Undisturbed(content=content, operations=operations)
        return self._known[stage.name]


ENVIRONMENT = {
    "RAY_AUTH_MODE": "disabled", "RAY_USAGE_STATS_ENABLED": "0", "OMP_WAIT_POLICY": "PASSIVE",
    # a lost cluster is given up after a minute otherwise
    "RAY_gcs_rpc_server_reconnect_timeout_s": "5",
}  # fmt: skip


@contextmanager
def ground(scratch: Path, quick: bool = False) -> Iterator[Ground]:
    """A ground in a folder, with a Ray cluster of its own."""
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    scratch = scratch.resolve()
    hook = {"CHAOS": str(scratch / "fault.json"), "PYTHONPATH": os.pathsep.join(PATH)}
    with cluster(2, ENVIRONMENT | hook) as (head, address):
        made = Ground(scratch, ENVIRONMENT, head, address, quick)
        try:
            yield made
        finally:
            made.close()
