"""The stages survive faults of machines: a short campaign over every stage, judged by content.

`python -m tests.chaos` is the long one. The faults that it found stand here first, by their seeds.
"""

from pathlib import Path

import pytest

from tests.chaos.__main__ import line, table
from tests.chaos.campaign import Case, TrialResult, cases, run_trial
from tests.chaos.stages import STAGES, Stage
from tests.chaos.workspace import ENVIRONMENT, Workspace
from tests.launcher import Launcher
from tests.processes import Cluster

FOUND = {
    ("pack", "read ends early"): 0,  # the image was rejected for good
    ("pack", "output bit flipped"): 1,  # a byte of a record table that --verify did not check
    ("train", "input bit flipped"): 0,  # other weights, and no message
    ("train", "unfinished output bit flipped"): 0,  # training resumed from other weights
    ("embed", "output bit flipped"): 0,  # the part passed for finished
    ("index", "input deleted"): 0,  # an index of fewer rows
    ("index", "output deleted"): 0,  # passed for complete; its own command did not repair it
    ("evaluate", "unfinished output bit flipped"): 0,  # the remedy of the message did not help
}
"(stage, fault) that once did harm -> seed."
SPREAD = {
    "simulate": ("driver killed",),
    "pack": ("disk full", "input truncated", "worker killed"),
    "index": ("read fails",),
}
"""Stage -> other faults, so that each stage and each kind of fault comes up once at least. The long
campaign has them all for every stage; workers of Ray Train are killed in
tests/jobs/test_checkpoints.py, those that embed in tests/features/test_embed_faults.py, jobs are
interrupted in tests/jobs/test_signals.py."""


@pytest.fixture(scope="module")
def workspace(
    tmp_path_factory: pytest.TempPathFactory,
    ray_session: Cluster,
    storage_faults: Path,
    prepared: Launcher,
) -> Workspace:
    """On the session's Ray."""
    scratch = tmp_path_factory.mktemp("chaos")
    return Workspace(scratch, ray_session, storage_faults, ENVIRONMENT, quick=prepared)


def short_campaign(stage: Stage) -> list[Case]:
    """The cases of a stage in their order."""
    seeds = {fault: seed for (name, fault), seed in FOUND.items() if name == stage.name}
    seeds |= dict.fromkeys(SPREAD.get(stage.name, ()), 1)
    known = {(case.name, seed): case for seed in (0, 1) for case in cases(stage, seed)}
    return [known[fault, seed] for fault, seed in seeds.items()]


def test_short_campaign_has_every_stage_and_kind_of_fault() -> None:
    tried = [case for stage in STAGES for case in short_campaign(stage)]
    assert {case.stage.name for case in tried} == {stage.name for stage in STAGES}
    known = {case.kind for stage in STAGES for case in cases(stage, seed=0)}
    left = known - {case.kind for case in tried}
    assert left == {"driver terminated", "worker terminated", "cluster killed"}


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
def test_stage_after_faults_equals_undisturbed_run(workspace: Workspace, stage: Stage) -> None:
    workspace.baseline(stage)
    results = [run_trial(workspace, case) for case in short_campaign(stage)]
    assert [result for result in results if result.failed] == []
    assert sum(result.faults > 0 for result in results) > len(results) / 2


def test_long_campaign_prints_a_line_and_a_table_row() -> None:
    case = Case(stage=STAGES[1], kind="driver killed", seed=3)
    good = TrialResult(case, faults=1, runs=2, restart_seconds=0.5)
    bad = TrialResult(case, faults=1, runs=2, lost=["a.tar"], detected="by default")
    assert " ".join(line(good).split()) == (
        "pack seed 3 driver killed faults 1 runs 2 restart 0.5 s"
    )
    assert line(bad).endswith("by default FAILED a.tar")
    assert table([good, bad]).splitlines()[2:] == [
        "| pack | driver killed | 2 | 4 | 1 | 0 | 0 | 0 | 1 / 0 | 0.2 |",
        "| pack | all | 2 | 4 | 1 | 0 | 0 | 0 | 1 / 0 | 0.2 |",
    ]
