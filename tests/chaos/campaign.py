"""The campaign: a stage runs, meets faults, is run again by the same command, and its content is
compared.

A trial's verdict is by content: what the stage has written in the end equals what an undisturbed
run wrote. Where a run refuses, what its sentence asks for is done: a damaged input is put back (the
stage before it makes it again), a damaged output that it names is deleted.
"""

import random
import re
import shutil
import signal
from dataclasses import dataclass, field

from tests.chaos.faults import DAMAGE, KILLS, PLACES, STORAGE, Damaged, damage
from tests.chaos.grounds import Ground, Undisturbed
from tests.chaos.stages import Stage
from tests.launcher import Ended
from tests.processes import strike

TRIES = 6
"Runs after the faults in which the stage has to come to its end."
PASSED_OVER = ("tensorboard", "ray", "job.log", ".parts")


@dataclass(frozen=True, kw_only=True)
class Case:
    """One trial: which fault the stage meets."""

    stage: Stage
    kind: str
    "Of KILLS, STORAGE or DAMAGE."
    place: str = ""
    "Of PLACES, for damage."
    seed: int

    @property
    def name(self) -> str:
        return f"{self.place} {self.kind}".strip()


@dataclass
class Verdict:
    """What came of a trial."""

    case: Case
    faults: int = 0
    "That were injected: a kill that came too late counts as none."
    runs: int = 0
    found: str = ""
    "How damage was noticed: by default, by --verify, or it made no difference."
    lost: list[str] = field(default_factory=list)
    "Content that is missing in the end, or another than it should be."
    doubled: list[str] = field(default_factory=list)
    "Content that should not be there."
    hangs: int = 0
    unclear: list[str] = field(default_factory=list)
    "Last lines of runs that ended in a traceback instead of a sentence."
    restart_seconds: float = 0.0
    "Of the run that came to the end, over an undisturbed run's."

    @property
    def bad(self) -> bool:
        return bool(self.lost or self.doubled or self.hangs or self.unclear)


def cases(stage: Stage, seed: int) -> list[Case]:
    """One trial of every fault that the stage can meet."""
    kills = [Case(stage=stage, kind=kind, seed=seed) for kind in KILLS]
    storage = [
        Case(stage=stage, kind=kind, seed=seed)
        for kind in STORAGE
        if stage.reads or STORAGE[kind] == "write"
    ]
    damages = [
        Case(stage=stage, kind=kind, place=place, seed=seed)
        for place in PLACES
        if stage.reads or place != "input"
        for kind in DAMAGE
    ]
    return [
        case
        for case in kills + storage + damages
        if not any(word in case.name for word in stage.blind)
    ]


def trial(ground: Ground, case: Case) -> Verdict:
    """Let a stage meet a fault, bring it to its end, and judge."""
    stage, rng, verdict = (
        case.stage,
        random.Random(repr((case.stage.name, case.name, case.seed))),
        Verdict(case),
    )
    usual = ground.undisturbed(stage)
    damaged: list[Damaged] = []
    if case.kind in KILLS:
        _kill(ground, case, rng, verdict)
    elif case.kind in STORAGE:
        ground.prepare(stage)
        _spoil_operation(ground, case, rng, usual, verdict)
    else:
        damaged = _damage(ground, case, rng, verdict)
    _bring_to_its_end(ground, case, usual, verdict, damaged)
    return verdict


def _spread(ground: Ground, case: Case, rng: random.Random) -> bool:
    """Whether Ray's workers do it where one process could."""
    return not case.stage.alone or (rng.random() < 0.5 and not ground.quick)


def _kill(ground: Ground, case: Case, rng: random.Random, verdict: Verdict) -> None:
    """Up to three kills at random moments, of workers; one of the driver or of the cluster.

    A run that is over before the first of them tells how long it takes, and another one is begun.
    """
    spread = not case.kind.startswith("driver") or _spread(ground, case, rng)
    own = case.kind.startswith("cluster")
    extent = ground.seconds(case.stage, spread) + (6.0 if own else 0.0)
    kills = 3 if case.kind.startswith("worker") else 1
    for _ in range(TRIES):
        ground.prepare(case.stage)
        job = ground.start(case.stage, spread, own_cluster=own)
        for moment in sorted(rng.uniform(0, extent) for _ in range(kills)):
            if job.wait(moment):
                break
            while not (victims := ground.victims(job, case.kind)) and not job.wait(
                job.seconds + 0.02
            ):
                pass
            verdict.faults += bool(victims) and strike(rng.choice(victims), KILLS[case.kind])
        ended = job.end(ground.patience(case.stage))
        _judge_run(verdict, ended)
        if verdict.faults:
            return
        extent = min(extent, ended.seconds)


def _spoil_operation(
    ground: Ground, case: Case, rng: random.Random, usual: Undisturbed, verdict: Verdict
) -> None:
    count = max(1, usual.operations[STORAGE[case.kind]])
    at = rng.randrange(count)
    ground.arm(case.kind, at)
    ended = ground.run(case.stage, spread=_spread(ground, case, rng))
    verdict.faults += ground.disarm()[STORAGE[case.kind]] > at
    _judge_run(verdict, ended)


def _damage(ground: Ground, case: Case, rng: random.Random, verdict: Verdict) -> list[Damaged]:
    """Spoil a file: of the input, before a run or during it; of the finished output; of what a
    killed run left.
    """
    stage = case.stage
    ground.prepare(stage, without=case.place != "output")
    if case.place == "input":
        during = rng.random() < 0.5
        folder = ground.here / rng.choice(stage.reads)
        job = ground.start(stage, spread=False) if during else None
        if job is not None:
            job.wait(rng.uniform(0, ground.seconds(stage, False)))
        spoilt = damage(folder, case.kind, rng, PASSED_OVER)
        ended = (
            job.end(ground.patience(case.stage))
            if job is not None
            else ground.run(stage, spread=False)
        )
        _judge_run(verdict, ended)
        verdict.found = "by default" if ended.code else ""
    else:
        if case.place == "unfinished output":
            job = ground.start(stage, spread=False)
            job.wait(rng.uniform(0.5, 1.0) * ground.seconds(stage, False))
            strike(job.pid, signal.SIGKILL)
            _judge_run(verdict, job.end(ground.patience(case.stage)))
        spoilt = damage(ground.here / stage.writes, case.kind, rng, PASSED_OVER)
    verdict.faults += spoilt is not None
    return [spoilt] if spoilt is not None else []


def _bring_to_its_end(
    ground: Ground, case: Case, usual: Undisturbed, verdict: Verdict, damaged: list[Damaged]
) -> None:
    """Run the same command until it succeeds, doing what its sentences ask for, and compare."""
    stage = case.stage
    for _ in range(TRIES):
        ended = ground.run(stage, spread=False)
        _judge_run(verdict, ended)
        if ended.code != 0:
            verdict.found = verdict.found or "by default"
            _mend(ground, case, ended, damaged)
            continue
        verdict.restart_seconds = max(0.0, ended.seconds - ground.seconds(stage, False))
        wrong = _differences(ground, stage, usual)
        if not any(wrong):
            verdict.found = verdict.found or ("no difference" if damaged else "")
            return
        checked = _look_closely(ground, case, damaged)
        if checked is None or (checked.code == 0 and any(_differences(ground, stage, usual))):
            verdict.lost, verdict.doubled = wrong
            return
        verdict.found = "by --verify"
        if checked.code == 0:  # and mended
            return
        _mend(ground, case, checked, damaged)
    verdict.lost = [f"no end after {TRIES} runs: {ended.said.strip().splitlines()[-1:]}"]


def _look_closely(ground: Ground, case: Case, damaged: list[Damaged]) -> Ended | None:
    """What the check of every byte says of damage that made a difference and went unseen; None
    where there is no such check.

    Of an input, the stage is begun anew on the same damage and told to look first.
    """
    if not damaged:
        return None
    if case.place == "input":
        ground.prepare(case.stage)
        for one in damaged:
            one.repeat()
    elif case.stage.verify:
        return ground.check(case.stage)
    return ground.run(case.stage, spread=False, guarded=True) if case.stage.guard else None


def _mend(ground: Ground, case: Case, ended: Ended, damaged: list[Damaged]) -> None:
    """What a sentence asks for: inputs are put back, outputs that it names are deleted."""
    if case.place == "input":
        for one in damaged:
            one.restore()
        return
    folder = ground.here / case.stage.writes
    said = re.sub(r"\s*\n\s*", "", ended.said) + " " + ended.said.replace("\n", " ")
    if re.search(rf"delete {re.escape(str(folder))}(?![^ ;,])", said):
        shutil.rmtree(folder)
    for path in sorted(folder.rglob("*"), reverse=True):
        if path.is_file() and str(path) in said:
            path.unlink()


def _differences(ground: Ground, stage: Stage, usual: Undisturbed) -> tuple[list[str], list[str]]:
    """What is lost and what is doubled."""
    try:
        got = stage.held(ground.here)
    except Exception as error:  # what cannot be read is lost, whatever it raises
        return [f"{type(error).__name__}: {error}"], []
    lost = [name for name, value in usual.content.items() if name not in got or got[name] != value]
    return lost, [name for name in got if name not in usual.content]


def _judge_run(verdict: Verdict, ended: Ended) -> None:
    verdict.runs += 1
    verdict.hangs += ended.code is None
    if "Traceback (most recent call last)" in ended.said and ended.code not in (0, None):
        verdict.unclear.append(ended.said.strip().splitlines()[-1])
