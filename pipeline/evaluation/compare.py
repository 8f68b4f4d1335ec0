"""Finished evaluations side by side: their folders in; tables of figures, differences and p values
out, with the figures that papers published.

The first run is the baseline. Runs are compared on the same queries, resampled by location
(retrieval/bootstrap.py).
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.core.arrays import Doubles
from pipeline.core.errors import InputError
from pipeline.evaluation.published import (
    PUBLISHED_ABLATION,
    PUBLISHED_MULTI_QUERY,
    PUBLISHED_TABLE,
    impossible_means,
)
from pipeline.report.inputs import EvaluationResults, task_key
from pipeline.retrieval.bootstrap import paired_difference
from pipeline.retrieval.metrics import hits_at

COMPARED_METRICS = ("r1", "ap")
IMPOSSIBLE = "impossible"
"Marks an AP that its R@1 excludes (`impossible_ap`)."
MAIN_TASKS = ("drone->satellite", "satellite->drone")
TASK_HEADINGS = {"drone->satellite": "UAV to satellite", "satellite->drone": "satellite to UAV"}


def compare(runs: Sequence[EvaluationResults]) -> list[dict[str, Any]]:
    """One row per run and task of the first run: its metrics, whether R@1 and AP contradict each
    other (`impossible`) and, for every later run, the differences of R@1 and AP with their 95 %
    intervals and p.

    Raises InputError if there are fewer than two runs, two have one name, none shares a task with
    the first, or a shared task was run on other queries or another gallery.
    """
    names = [run.name for run in runs]
    if len(runs) < 2 or len(set(names)) < len(names):
        raise InputError(
            f"found the runs {', '.join(names)}; expected two or more of different names; "
            "rename or add folders"
        )
    baseline, rows = runs[0], []
    for base in baseline.metrics:
        rows.append({"run": baseline.name, **base} | _contradiction(baseline, base))
        for run in runs[1:]:
            own = run.metrics_for(base)
            if own is not None:
                row = {"run": run.name, **own} | _contradiction(run, base)
                rows.append(row | _differences(run, baseline, base))
    if len(rows) == len(baseline.metrics):
        found = "; ".join(
            f"{run.name}: {', '.join(' '.join(map(str, task_key(m)[:2])) for m in run.metrics)}"
            for run in runs
        )
        raise InputError(
            f"no run shares a task and protocol with the first ({found}); "
            "expected the same evaluations"
        )
    return rows


def _contradiction(run: EvaluationResults, base: dict[str, Any]) -> dict[str, Any]:
    table = rows_by_query(run, base)
    figures = (metric_by_query(table, name) for name in COMPARED_METRICS)
    return {"impossible": impossible_means(*figures)}


def _differences(
    run: EvaluationResults, baseline: EvaluationResults, base: dict[str, Any]
) -> dict[str, Any]:
    own, other = (rows_by_query(each, base) for each in (run, baseline))
    if own["query"].to_pylist() != other["query"].to_pylist():
        raise InputError(
            f"{run.name} and {baseline.name} ranked different queries for {base['task']}; "
            "expected the same images; embed and evaluate both on the same shards"
        )
    locations_Q = np.asarray(other["location"].to_pylist(), np.str_)
    found: dict[str, Any] = {}
    for name in COMPARED_METRICS:
        difference = paired_difference(
            metric_by_query(own, name), metric_by_query(other, name), locations_Q
        )
        found |= {f"{name}_difference_{key}": value for key, value in asdict(difference).items()}
    return found


def rows_by_query(run: EvaluationResults, base: dict[str, Any]) -> pa.Table:
    """The queries of a metric row's task, sorted by key: query, location, first_match_rank, ap."""
    columns = ("query", "location", "first_match_rank", "ap")
    rows = [{name: row[name] for name in columns} for row in run.rows_for(base)]
    return pa.Table.from_pylist(sorted(rows, key=lambda row: str(row["query"])))


def metric_by_query(table: pa.Table, name: str) -> Doubles:
    """Each query's `ap`, or whether it has a match at rank 1 (`r1`), (Q,)."""
    if name == "ap":
        return np.asarray(table["ap"].to_numpy(), np.float64)
    return hits_at(
        1, np.array([rank or 0 for rank in table["first_match_rank"].to_pylist()], np.int64)
    )


def markdown(rows: Sequence[dict[str, Any]], published: bool = False) -> str:
    """The three tables as Markdown."""
    parts = []
    for title, heading, lines in _tables(rows, published):
        body = [f"| {' | '.join(line)} |" for line in lines]
        parts += [
            f"### {title}",
            "",
            f"| {' | '.join(heading)} |",
            "|---" + "|---:" * (len(heading) - 1) + "|",
            *body,
            "",
        ]
    return "\n".join(parts)


def latex(rows: Sequence[dict[str, Any]], published: bool = False) -> str:
    """The three tables as LaTeX, for a document that loads booktabs."""
    parts = []
    for title, heading, lines in _tables(rows, published):
        body = [f"  {' & '.join(_escape_latex(cell) for cell in line)} \\\\" for line in lines]
        parts += [
            "\\begin{table}",
            "  \\centering",
            f"  \\caption{{{_escape_latex(title)}}}",
            f"  \\begin{{tabular}}{{l{'r' * (len(heading) - 1)}}}",
            "  \\toprule",
            f"  {' & '.join(_escape_latex(cell) for cell in heading)} \\\\",
            "  \\midrule",
            *body,
            "  \\bottomrule",
            "  \\end{tabular}",
            "\\end{table}",
            "",
        ]
    return "\n".join(parts)


def _tables(
    rows: Sequence[dict[str, Any]], published: bool
) -> list[tuple[str, list[str], list[list[str]]]]:
    """Title, headings and lines of the tables that have lines: both directions, multi-query,
    differences.
    """
    runs = list(dict.fromkeys(row["run"] for row in rows))
    protocols = ", ".join(dict.fromkeys(f"{row['protocol']} protocol" for row in rows))
    singles = {(row["run"], row["task"]): row for row in rows if not row["multi_query"]}
    tasks = [
        task
        for task in dict.fromkeys(row["task"] for row in rows)
        if any((run, task) in singles for run in runs)
    ]
    tasks.sort(key=lambda task: MAIN_TASKS.index(task) if task in MAIN_TASKS else len(MAIN_TASKS))
    heading = [
        "Method",
        *(
            f"{TASK_HEADINGS.get(task, task)} {measure}"
            for task in tasks
            for measure in ("R@1", "AP")
        ),
    ]
    lines = [
        [run, *_percent_cells([singles.get((run, task)) for task in tasks], ("r1", "ap"))]
        for run in runs
    ]
    for line in (*PUBLISHED_TABLE, *PUBLISHED_ABLATION) if published else ():
        figures = [line.for_task(task) or (None, None) for task in tasks]
        cells = ["-" if value is None else f"{value:.2f}" for pair in figures for value in pair]
        gallery = ", gallery without distractors" if line.protocol == "queried-only" else ""
        wrong = f", {IMPOSSIBLE}" if line.impossible else ""
        lines.append([f"{line.method}, {line.pixels} px (published{gallery}{wrong})", *cells])
    tables = [(f"Both directions, percent, {protocols}", heading, lines)]
    merged = {
        row["run"]: row for row in rows if row["multi_query"] and row["task"] == MAIN_TASKS[0]
    }
    lines = [
        [run, *_percent_cells([merged[run]], ("r1", "r5", "ap"))] for run in runs if run in merged
    ]
    for pixels, known in PUBLISHED_MULTI_QUERY.items() if published and lines else ():
        lines.append([f"PVDA, {pixels} px (published)", *(f"{value:.2f}" for value in known)])
    tables.append(
        (
            f"Multi-query UAV to satellite, percent, {protocols}",
            ["Method", "R@1", "R@5", "AP"],
            lines,
        )
    )
    heading = ["Method", "Task", "R@1", "95 % interval", "p", "AP", "95 % interval", "p"]
    lines = [
        [row["run"], _name(row), *_difference_cells(row)]
        for row in rows
        if "r1_difference_mean" in row
    ]
    tables.append(
        (f"Differences to {runs[0]}, points, paired bootstrap over locations", heading, lines)
    )
    return [table for table in tables if table[2]]


def _percent_cells(rows: Sequence[dict[str, Any] | None], measures: Sequence[str]) -> list[str]:
    return [_percent_cell(row, measure) for row in rows for measure in measures]


def _percent_cell(row: dict[str, Any] | None, measure: str) -> str:
    if row is None:
        return "-"
    mark = f" {IMPOSSIBLE}" if measure == "ap" and row["impossible"] else ""
    return f"{100 * float(row[measure]):.2f}{mark}"


def _name(row: dict[str, Any]) -> str:
    task = str(row["task"])
    return TASK_HEADINGS.get(task, task) + (", multi-query" if row["multi_query"] else "")


def _difference_cells(row: dict[str, Any]) -> list[str]:
    cells = []
    for name in COMPARED_METRICS:
        mean, low, high, p = (
            row[f"{name}_difference_{part}"] for part in ("mean", "low", "high", "p")
        )
        cells += [f"{100 * mean:+.2f}", f"{100 * low:+.2f} to {100 * high:+.2f}", f"{p:.3f}"]
    return cells


def _escape_latex(text: str) -> str:
    special = {
        "\\": r"\textbackslash{}",
        "->": r"$\to$",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
    }
    special |= {sign: "\\" + sign for sign in "&%$#_{}"}
    out, i = "", 0
    while i < len(text):
        token = text[i : i + 2] if text[i : i + 2] == "->" else text[i]
        out += special.get(token, token)
        i += len(token)
    return out
