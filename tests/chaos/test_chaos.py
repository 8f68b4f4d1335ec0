"""The road survives what machines do to it: a short fault campaign over every stage, judged by
content.

benchmarks/chaos.py is the long one. What that found stands here first, by its seed.
"""

from collections.abc import Iterator

import pytest

from tests.chaos.campaign import Case, Verdict, cases, trial
from tests.chaos.grounds import Ground, ground
from tests.chaos.stages import STAGES, Stage

FAULTS = 10
"Per stage, besides those that once did harm."
HARMED = {
    ("pack", "read ends early"): 0,  # the image was refused for good
    ("pack", "output bit flipped"): 1,  # a byte of a record table that --verify did not look at
    ("train", "input bit flipped"): 0,  # other weights, without a word
    ("train", "unfinished output bit flipped"): 0,  # training went on from other weights
    ("embed", "output bit flipped"): 0,  # the part passed for finished
    ("index", "input deleted"): 0,  # an index of fewer rows
    ("index", "output deleted"): 0,  # complete, it said, and could not be mended by its own command
    ("evaluate", "unfinished output bit flipped"): 0,  # what its sentence asked for did not help
}
"Stage and fault -> seed."
QUICK = ("worker", "driver", "read", "disk", "output", "input", "unfinished")
"""The faults of the short campaign, in their order. A lost cluster takes longest, and Ray Train
nearly so."""


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ground]:
    with ground(tmp_path_factory.mktemp("chaos"), quick=True) as made:
        yield made


def chosen(stage: Stage) -> list[Case]:
    """The trials of a stage in their order."""
    harmed = [
        case
        for (name, fault), seed in HARMED.items()
        if name == stage.name
        for case in cases(stage, seed)
        if case.name == fault
    ]
    quick = [case for word in QUICK for case in cases(stage, seed=1) if case.name.startswith(word)]
    passed_over = {one.name for one in harmed}
    if stage.name == "train":
        passed_over |= {"worker killed", "worker terminated"}
    return harmed + [case for case in quick if case.name not in passed_over]


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
def test_a_stage_that_meets_faults_ends_with_what_an_undisturbed_one_writes(
    here: Ground, stage: Stage
) -> None:
    here.undisturbed(stage)
    verdicts = list[Verdict]()
    for case in chosen(stage):
        verdicts.append(trial(here, case))
        if sum(verdict.faults for verdict in verdicts) >= FAULTS:
            break
    assert [verdict for verdict in verdicts if verdict.bad] == []
    assert sum(verdict.faults for verdict in verdicts) >= min(FAULTS, len(verdicts) // 2)
