"""Leaderboard rows: means over seeds, differences by query, figures that contradict each other."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from pipeline.core.errors import InputError
from pipeline.evaluation.leaderboard import Cost, leaderboard, leaderboard_markdown
from pipeline.evaluation.published import (
    PUBLISHED_ABLATION,
    PUBLISHED_SINCE,
    PUBLISHED_TABLE,
    impossible_ap,
)
from pipeline.report.inputs import EvaluationResults
from pipeline.report.leaderboard import render_leaderboard

TASK = "drone->satellite"
COST = Cost(parameters=5_000_000, gmac=0.4, numbers=1024, images_per_second=40.0, minutes=3.0)


def evaluation(name: str, ranks: list[int], task: str = TASK) -> EvaluationResults:
    """Queries q0, q1, ... of places p0, p0, p1, ..., each with the rank of its first match."""
    keys = {"task": task, "protocol": "full", "multi_query": False}
    rows = [
        {"query": f"q{at}", "location": f"p{at // 2}", "first_match_rank": rank, "ap": 1 / rank}
        | keys
        for at, rank in enumerate(ranks, start=0)
    ]
    hit = float(np.mean([rank == 1 for rank in ranks]))
    metrics = [keys | {"queries": len(ranks), "gallery": 9, "r1": hit, "ap": hit}]
    return EvaluationResults(name=name, metrics=metrics, results=pa.Table.from_pylist(rows))


def test_leaderboard_averages_seeds_and_pairs_queries() -> None:
    first_rank = evaluation("a", [1, 2, 1, 3]).results["first_match_rank"].to_pylist()
    assert first_rank == [1, 2, 1, 3]
    runs = {
        "control": [evaluation("c", [1, 2, 2, 2])],
        "method": [evaluation("m0", [1, 1, 2, 2]), evaluation("m1", [1, 1, 1, 2])],
    }
    control, method = leaderboard(runs, dict.fromkeys(runs, COST))
    assert method.seeds == 2
    assert method.tasks[0].r1 == pytest.approx((0.5 + 0.75) / 2)
    assert method.tasks[0].by_seed == (0.5, 0.75)
    assert control.tasks[0].difference is None
    assert method.tasks[0].difference is not None
    assert method.tasks[0].difference.mean == pytest.approx(0.625 - 0.25)
    text = leaderboard_markdown([control, method])
    assert text.splitlines()[2].startswith("| method | 2 | 62.5%")
    page = render_leaderboard(
        [row.as_dict() for row in (control, method)], published=[], data="A set", terms="few images"
    )
    assert page.index('<th scope="row">method') < page.index('<th scope="row">control')


@pytest.mark.parametrize(("ap_of_hits", "marked"), [(1.0, True), (0.8, False)])
def test_leaderboard_marks_contradictions_of_one_match(ap_of_hits: float, marked: bool) -> None:
    run = evaluation("a", [1, 2, 1, 2])  # AP 1/2 at rank 2, where one match gives at most 1/4
    aps = [ap_of_hits if rank == 1 else 0.5 for rank in (1, 2, 1, 2)]
    results = run.results.set_column(run.results.column_names.index("ap"), "ap", pa.array(aps))
    runs = {"a": [replace(run, results=results)]}
    [row] = leaderboard(runs, {"a": COST})
    assert row.tasks[0].impossible is marked
    page = render_leaderboard([row.as_dict()], published=[], data="A set", terms="few images")
    assert ("impossible beside this R@1" in page) is marked


def test_leaderboard_refuses_other_queries() -> None:
    runs = {"a": [evaluation("a", [1, 2])], "b": [evaluation("b", [1, 2, 1])]}
    with pytest.raises(InputError, match="b and a ranked different queries"):
        leaderboard(runs, dict.fromkeys(runs, COST))


@pytest.mark.parametrize(
    ("r1", "ap", "impossible"),
    [(50, 50, False), (50, 62.5, False), (50, 62.6, True), (50, 49.9, True), (100, 100, False),
     (95.82, 97.77, True), (96.01, 92.84, True), (92.21, 90.39, True)],
)  # fmt: skip
def test_impossible_ap_follows_from_one_match(r1: float, ap: float, impossible: bool) -> None:
    assert impossible_ap(r1, ap) is impossible


@pytest.mark.parametrize(("ap", "marked"), [(97.77, True), (96.5, False)])
def test_page_marks_contradictions_of_others(ap: float, marked: bool) -> None:
    [row] = leaderboard({"a": [evaluation("a", [1, 1])]}, {"a": COST})
    other = replace(PUBLISHED_TABLE[0], method="Other", drone_to_satellite=(95.82, ap))
    page = render_leaderboard(
        [row.as_dict()],
        published=[vars(other) | {"impossible": other.impossible}],
        data="A set", terms="few images",
    )  # fmt: skip
    assert ("impossible beside this R@1" in page) is marked


def test_published_figures_are_possible() -> None:
    for row in (*PUBLISHED_TABLE, *PUBLISHED_ABLATION, *PUBLISHED_SINCE):
        assert not impossible_ap(*row.drone_to_satellite), row
