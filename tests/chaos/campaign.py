"""One trial of the campaign: a stage meets a fault, is rerun by the same command, is compared.

The verdict is by content: a stage's final output equals that of an undisturbed run. Where a run
refuses, the remedy of its error message is applied: a damaged input is restored (the stage before
would make it again), a damaged output that the message names is deleted.
"""

import random
import re
import shutil
import signal
from dataclasses import dataclass, field

from tests.chaos.faults import DAMAGE, KILLS, STORAGE, TARGETS, DamagedFile, damage_file
from tests.chaos.stages import Stage
from tests.chaos.workspace import Baseline, Workspace
from tests.launcher import JobResult
from tests.processes import send_signal

MAX_RERUNS = 6
"Runs after the fault within which the stage has to complete."
IGNORED = ("tensorboard", "ray", "job.log", ".parts")
"Files and folders that are never damaged."


@dataclass(frozen=True, kw_only=True)
class Case:
    """The fault of one trial."""

    stage: Stage
    kind: str
    "One of KILLS, STORAGE or DAMAGE."
    target: str = ""
    "One of TARGETS, for damage."
    seed: int

    @property
    def name(self) -> str:
        return f"{self.target} {self.kind}".strip()


@dataclass
class TrialResult:
    """The outcome of one trial."""

    case: Case
    faults: int = 0
    "Faults injected; a kill after the end of the run does not count."
    runs: int = 0
    detected: str = ""
    "How damage was noticed: by default, by --verify, or it made no difference."
    lost: list[str] = field(default_factory=list)
    "Content that is missing or differs in the end."
    duplicated: list[str] = field(default_factory=list)
    "Content that an undisturbed run does not have."
    hangs: int = 0
    tracebacks: list[str] = field(default_factory=list)
    "Last lines of runs that ended in a traceback instead of a one-line error."
    restart_seconds: float = 0.0
    "Duration of the run that completed, beyond an undisturbed run's."

    @property
    def failed(self) -> bool:
        return bool(self.lost or self.duplicated or self.hangs or self.tracebacks)


def cases(stage: Stage, seed: int) -> list[Case]:
    """One case of every fault that the stage can meet and detect."""
    kills = [Case(stage=stage, kind=kind, seed=seed) for kind in KILLS]
    storage = [
        Case(stage=stage, kind=kind, seed=seed)
        for kind in STORAGE
        if stage.reads or STORAGE[kind] == "write"
    ]
    damages = [
        Case(stage=stage, kind=kind, target=target, seed=seed)
        for target in TARGETS
        if stage.reads or target != "input"
        for kind in DAMAGE
    ]
    return [
        case
        for case in kills + storage + damages
        if not any(word in case.name for word in stage.undetectable)
    ]


def run_trial(workspace: Workspace, case: Case) -> TrialResult:
    """Inject the fault, rerun the stage until it completes, compare its content."""
    rng = random.Random(repr((case.stage.name, case.name, case.seed)))
    result = TrialResult(case)
    baseline = workspace.baseline(case.stage)
    damaged: list[DamagedFile] = []
    if case.kind in KILLS:
        _inject_kills(workspace, case, rng, result)
    elif case.kind in STORAGE:
        workspace.prepare(case.stage)
        _inject_storage_fault(workspace, case, rng, baseline, result)
    else:
        damaged = _inject_damage(workspace, case, rng, result)
    _rerun_until_complete(workspace, case, baseline, result, damaged)
    return result


def _is_distributed(workspace: Workspace, case: Case, rng: random.Random) -> bool:
    """Whether Ray's workers run the stage, which one process can run."""
    return rng.random() < 0.5 and not workspace.quick


def _inject_kills(
    workspace: Workspace, case: Case, rng: random.Random, result: TrialResult
) -> None:
    """Up to three kills of workers at random moments; one of the driver or of the cluster.

    A run that ends before the first kill gives its duration, and another run is started.
    """
    distributed = not case.kind.startswith("driver") or _is_distributed(workspace, case, rng)
    own_cluster = case.kind.startswith("cluster")
    duration = workspace.seconds(case.stage, distributed) + (6.0 if own_cluster else 0.0)
    kills = 3 if case.kind.startswith("worker") else 1
    for _ in range(MAX_RERUNS):
        workspace.prepare(case.stage)
        job = workspace.start(case.stage, distributed, own_cluster=own_cluster)
        for moment in sorted(rng.uniform(0, duration) for _ in range(kills)):
            if job.wait(moment):
                break
            while not (victims := workspace.victims(job, case.kind)) and not job.wait(
                job.seconds + 0.02
            ):
                pass
            result.faults += bool(victims) and send_signal(rng.choice(victims), KILLS[case.kind])
        ended = job.end(workspace.timeout_s(case.stage))
        _record_run(result, ended)
        if result.faults:
            return
        duration = min(duration, ended.seconds)


def _inject_storage_fault(
    workspace: Workspace,
    case: Case,
    rng: random.Random,
    baseline: Baseline,
    result: TrialResult,
) -> None:
    operation = STORAGE[case.kind]
    at = rng.randrange(max(1, baseline.operations[operation]))
    workspace.arm(case.kind, at)
    ended = workspace.run(case.stage, distributed=_is_distributed(workspace, case, rng))
    result.faults += workspace.disarm()[operation] > at
    _record_run(result, ended)


def _inject_damage(
    workspace: Workspace, case: Case, rng: random.Random, result: TrialResult
) -> list[DamagedFile]:
    """Damage a file: of the input, before or during a run; of the finished or unfinished output."""
    stage = case.stage
    workspace.prepare(stage, with_output=case.target == "output")
    if case.target == "input":
        during_run = rng.random() < 0.5
        folder = workspace.folder / rng.choice(stage.reads)
        job = workspace.start(stage, distributed=False) if during_run else None
        if job is not None:
            job.wait(rng.uniform(0, workspace.seconds(stage, False)))
        damaged = damage_file(folder, case.kind, rng, IGNORED)
        if job is not None:
            ended = job.end(workspace.timeout_s(stage))
        else:
            ended = workspace.run(stage, distributed=False)
        _record_run(result, ended)
        result.detected = "by default" if ended.code else ""
    else:
        if case.target == "unfinished output":
            job = workspace.start(stage, distributed=False)
            job.wait(rng.uniform(0.5, 1.0) * workspace.seconds(stage, False))
            send_signal(job.pid, signal.SIGKILL)
            _record_run(result, job.end(workspace.timeout_s(stage)))
        damaged = damage_file(workspace.folder / stage.writes, case.kind, rng, IGNORED)
    result.faults += damaged is not None
    return [damaged] if damaged is not None else []


def _rerun_until_complete(
    workspace: Workspace,
    case: Case,
    baseline: Baseline,
    result: TrialResult,
    damaged: list[DamagedFile],
) -> None:
    """Rerun the same command until it succeeds, applying remedies, and compare the content."""
    stage = case.stage
    for _ in range(MAX_RERUNS):
        ended = workspace.run(stage, distributed=False)
        _record_run(result, ended)
        if ended.code != 0:
            result.detected = result.detected or "by default"
            _apply_remedy(workspace, case, ended, damaged)
            continue
        result.restart_seconds = max(0.0, ended.seconds - workspace.seconds(stage, False))
        differences = _differences(workspace, stage, baseline)
        if not any(differences):
            result.detected = result.detected or ("no difference" if damaged else "")
            return
        verified = _verify(workspace, case, damaged)
        if verified is None or (
            verified.code == 0 and any(_differences(workspace, stage, baseline))
        ):
            result.lost, result.duplicated = differences
            return
        result.detected = "by --verify"
        if verified.code == 0:  # --verify repaired the output as well
            return
        _apply_remedy(workspace, case, verified, damaged)
    result.lost = [f"no end after {MAX_RERUNS} runs: {ended.output.strip().splitlines()[-1:]}"]


def _verify(workspace: Workspace, case: Case, damaged: list[DamagedFile]) -> JobResult | None:
    """Run the check of every byte, for damage that the stage missed; None if there is no check.

    For a damaged input, the stage is started again on the same damage, with its inputs verified.
    """
    if not damaged:
        return None
    if case.target == "input":
        workspace.prepare(case.stage)
        for file in damaged:
            file.repeat()
    elif case.stage.verify_output:
        return workspace.verify_output(case.stage)
    if not case.stage.verify_input:
        return None
    return workspace.run(case.stage, distributed=False, verified=True)


def _apply_remedy(
    workspace: Workspace, case: Case, ended: JobResult, damaged: list[DamagedFile]
) -> None:
    """Apply an error message's remedy: restore inputs, delete the outputs that it names."""
    if case.target == "input":
        for file in damaged:
            file.restore()
        return
    folder = workspace.folder / case.stage.writes
    # The terminal wraps lines: a path may be cut by a line break, or end at one.
    message = re.sub(r"\s*\n\s*", "", ended.output) + " " + ended.output.replace("\n", " ")
    if re.search(rf"delete {re.escape(str(folder))}(?![^ ;,])", message):
        shutil.rmtree(folder)
    for path in sorted(folder.rglob("*"), reverse=True):
        if path.is_file() and str(path) in message:
            path.unlink()


def _differences(
    workspace: Workspace, stage: Stage, baseline: Baseline
) -> tuple[list[str], list[str]]:
    """Names of (lost, duplicated) content."""
    try:
        content = stage.read_content(workspace.folder)
    except Exception as error:  # unreadable content is lost, whatever the exception
        return [f"{type(error).__name__}: {error}"], []
    lost = [
        name
        for name, value in baseline.content.items()
        if name not in content or content[name] != value
    ]
    return lost, [name for name in content if name not in baseline.content]


def _record_run(result: TrialResult, ended: JobResult) -> None:
    result.runs += 1
    result.hangs += ended.code is None
    if "Traceback (most recent call last)" in ended.output and ended.code not in (0, None):
        result.tracebacks.append(ended.output.strip().splitlines()[-1])
