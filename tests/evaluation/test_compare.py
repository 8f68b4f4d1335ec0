"""Comparison of evaluations: differences worked by hand, Markdown and LaTeX tables, refusals."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from pipeline.core.errors import InputError
from pipeline.evaluation.compare import compare, latex, markdown
from pipeline.evaluation.evaluate import evaluate
from pipeline.evaluation.settings import EvaluationSettings
from pipeline.report.inputs import EvaluationResults, read_evaluation
from pipeline.retrieval.tasks import RESULTS_SCHEMA
from tests.evaluation.test_evaluate import TEST_SET, made_table


def run(
    name: str, ranks: list[int | None], task: str = "drone->satellite", multi: bool = False
) -> EvaluationResults:
    """An evaluation of queries of two images a location, from their first ranks."""
    rows = [
        {
            "query": f"q{i}",
            "location": f"{i // 2}",
            "task": task,
            "protocol": "full",
            "multi_query": multi,
            "first_match_rank": rank,
            "ap": 0.0 if rank is None else 1.0 if rank == 1 else 0.5 / rank,
        }
        for i, rank in enumerate(ranks)
    ]
    r1 = sum(rank == 1 for rank in ranks) / len(ranks)
    metrics = {
        "task": task,
        "protocol": "full",
        "multi_query": multi,
        "queries": len(ranks),
        "gallery": 9,
        "r1": r1,
        "r5": 1.0,
        "r10": 1.0,
        "r1p": r1,
        "ap": sum(float(row["ap"] or 0) for row in rows) / len(rows),
        "fingerprint": "f",
    }
    return EvaluationResults(
        name=name, metrics=[metrics], results=pa.Table.from_pylist(rows, RESULTS_SCHEMA)
    )


def test_compare_matches_queries_in_any_order() -> None:
    base, other = run("base", [1, 2, 1, 2] * 10), run("other_1", [1, 1, 1, None] * 10)
    shuffled = replace(other, results=other.results.take(list(range(39, -1, -1))))
    for mine in (other, shuffled):
        _, row = compare([base, mine])
        assert row["r1_difference_mean"] == pytest.approx(0.25)
        assert row["ap_difference_mean"] == pytest.approx((3 - (2 + 0.5)) / 4)
        assert row["r1_difference_low"] <= 0.25 <= row["r1_difference_high"]
        assert 0 < row["r1_difference_p"] < 0.05


def test_compare_of_equal_runs_is_zero() -> None:
    _, row = compare([run("a", [1, 2, 3, None]), run("b", [1, 2, 3, None])])
    assert [row[f"r1_difference_{name}"] for name in ("mean", "low", "high", "p")] == [0, 0, 0, 1]


def test_tables_list_runs_differences_and_published_figures() -> None:
    rows = compare([run("base", [1, 2] * 4), run("my_run", [1, 1] * 4)])
    text = markdown(rows, published=True)
    assert "| base | 50.00 | 62.50 |" in text
    assert "| my_run | 100.00 | 100.00 |" in text
    assert "| PVDA, 256 px (published) | 82.73 | 85.19 |" in text
    assert "| my_run | UAV to satellite | +50.00 |" in text
    assert "published" not in markdown(rows)
    tex = latex(rows)
    assert r"my\_run & 100.00 & 100.00 \\" in tex
    assert tex.count(r"\begin{table}") == tex.count(r"\end{table}") == 2
    assert r"95 \% interval" in tex


@pytest.mark.parametrize(("ap_of_hits", "marked"), [(1.0, True), (0.8, False)])
def test_tables_mark_figures_that_contradict_each_other(ap_of_hits: float, marked: bool) -> None:
    base, other = run("base", [1, 2] * 4), run("other", [1, 2] * 4)
    aps = [ap_of_hits, 0.9] * 4  # at rank 2 one match gives 1/4
    own = other.results.set_column(
        other.results.column_names.index("ap"), "ap", pa.array(aps, pa.float64())
    )
    rows = compare([base, replace(other, results=own)])
    assert [row["impossible"] for row in rows] == [False, marked]
    assert ("| other | 50.00 | 62.50 impossible |" in markdown(rows)) is marked


def test_tables_list_multi_query_apart() -> None:
    base, other = (run(name, [1, 2], multi=True) for name in "ab")
    text = markdown(compare([base, other]), published=True)
    assert "| a | 50.00 | 100.00 | 62.50 |" in text
    assert "| PVDA, 384 px (published) | 95.29 | 98.43 | 95.99 |" in text


@pytest.mark.parametrize(
    ("runs", "sentence"),
    [
        ([run("a", [1])], r"found the runs a; expected two or more"),
        ([run("a", [1]), run("a", [1])], r"different names"),
        ([run("a", [1]), run("b", [1], task="satellite->drone")], r"no run shares a task"),
        ([run("a", [1]), run("b", [1, 1])], r"b ranked 2 queries .* expected the same images"),
    ],
)
def test_compare_refuses_runs_that_do_not_match(
    runs: list[EvaluationResults], sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        compare(runs)


def test_compare_refuses_other_queries_of_equal_number() -> None:
    base, other = run("a", [1, 2]), run("b", [1, 2])
    named = other.results.set_column(0, "query", pa.array(["x", "y"]))
    with pytest.raises(InputError, match=r"b and a ranked different queries"):
        compare([base, replace(other, results=named)])


def test_compare_reads_finished_folders(tmp_path: Path) -> None:
    for seed, name in enumerate(("base", "again")):
        table = made_table(tmp_path / f"t{seed}", TEST_SET, seed=seed)
        evaluate(EvaluationSettings(table=table, out=str(tmp_path / name)))
    rows: list[dict[str, Any]] = compare(
        [read_evaluation(str(tmp_path / name)) for name in ("base", "again")]
    )
    assert [row["run"] for row in rows] == ["base", "again"] * 3
    assert markdown(rows).count("###") == 3
