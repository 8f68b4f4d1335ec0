"""The road survives what machines do to it: a short fault campaign over every stage, judged by content.

benchmarks/chaos.py is the long one. What it found stands here by its seed.
"""

from collections.abc import Iterator

import pytest
from campaign import Ground, Verdict, cases, ground, trial
from stages import STAGES, Stage

FAULTS = 10
"Per stage."
QUICK = ("driver killed", "read", "disk", "output", "input", "driver terminated", "worker killed")
"The faults of the short campaign; those that need Ray's workers last."


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ground]:
    with ground(tmp_path_factory.mktemp("chaos")) as made:
        yield made


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
def test_a_stage_that_meets_faults_ends_with_what_an_undisturbed_one_writes(here: Ground, stage: Stage) -> None:
    here.undisturbed(stage)
    verdicts = list[Verdict]()
    order = sorted(cases(stage, seed=1), key=lambda case: [case.name.startswith(word) for word in QUICK].index(True))
    for case in order:
        verdicts.append(trial(here, case))
        if sum(verdict.faults for verdict in verdicts) >= FAULTS:
            break
    assert [verdict for verdict in verdicts if verdict.bad] == []
