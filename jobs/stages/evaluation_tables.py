"""Evaluate, and print the tables of the result: metrics with intervals, distances, groups, view
gaps, and the figures that papers published."""

from collections.abc import Sequence
from typing import Any

from rich import box
from rich.table import Table

from pipeline.core.progress import results
from pipeline.evaluation.evaluate import evaluate
from pipeline.evaluation.published import PUBLISHED_ABLATION, PUBLISHED_TABLE
from pipeline.evaluation.settings import EvaluationSettings
from pipeline.report.inputs import read_extras
from pipeline.report.tasks import METRIC_LABELS
from pipeline.retrieval.parts import part_label

WITH_INTERVALS = ("r1", "r5", "ap")


def evaluate_and_print(settings: EvaluationSettings, published: bool) -> None:
    """Rank queries against galleries and measure: Recall@K and AP, official protocol first.

    `published`: print the figures that papers published for University-1652's official test too.
    """
    rows = evaluate(settings)
    print_table(rows)
    print_positions(rows)
    extras = read_extras(settings.out)
    print_groups(extras["views"], "views")
    print_groups(extras["groups"], "value")
    print_groups(
        [row | {"by": "part", "value": part_label(row)} for row in extras["parts"]], "value"
    )
    print_gaps(extras["gaps"])
    if published:
        print_published(list(dict.fromkeys(row["task"] for row in rows)))


def print_table(rows: list[dict[str, Any]]) -> None:
    """The metrics of one evaluation on standard output, in percent, with 95 % intervals."""
    table = _table(f"{rows[0]['protocol']} protocol, percent")
    table.add_column("task")
    for heading in (*METRIC_LABELS.values(), "queries", "gallery"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        counts = (f"{row['queries']:,}", f"{row['gallery']:,}")
        table.add_row(
            _task(row), *(f"{100 * row[measure]:.2f}" for measure in METRIC_LABELS), *counts
        )
    results.print(table)
    table = _table("95 % intervals: locations resampled")
    table.add_column("task")
    for measure in WITH_INTERVALS:
        table.add_column(METRIC_LABELS[measure], justify="right", no_wrap=True)
    for row in rows:
        table.add_row(_task(row), *(_interval(row, measure) for measure in WITH_INTERVALS))
    results.print(table)


def print_published(tasks: list[str]) -> None:
    """The figures that papers published for the official test, by task."""
    for task in tasks:
        table = _table(f"{task}, published (arXiv 2401.01573), percent")
        table.add_column("method")
        for heading in ("pixels", "R@1", "AP"):
            table.add_column(heading, justify="right", no_wrap=True)
        for line in (*PUBLISHED_TABLE, *PUBLISHED_ABLATION):
            if figures := line.for_task(task):
                table.add_row(
                    line.method, str(line.pixels), *(f"{figure:.2f}" for figure in figures)
                )
        if table.row_count:
            results.print(table)


def print_positions(rows: list[dict[str, Any]]) -> None:
    """Distance errors of the best answers, if positions are known."""
    known = [row for row in rows if row.get("distance_p90_m") is not None]
    if not known:
        return
    table = _table("distance of the best answer")
    for heading in (
        "task",
        "median",
        "90 %",
        "≤ 1 m",
        "5 m",
        "25 m",
        "SDM@1",
        "SDM@5",
        "queries",
    ):
        table.add_column(heading, justify="left" if heading == "task" else "right", no_wrap=True)
    for row in known:
        shares = (f"{100 * row[f'within_{metres}m']:.2f}" for metres in (1, 5, 25))
        marks = ("-" if row[f"sdm{k}"] is None else f"{100 * row[f'sdm{k}']:.2f}" for k in (1, 5))
        table.add_row(
            row["task"],
            f"{row['distance_median_m']:.1f} m",
            f"{row['distance_p90_m']:.1f} m",
            *shares,
            *marks,
            f"{row['geo_queries']:,}",
        )
    results.print(table)


def print_gaps(gaps: Sequence[dict[str, Any]]) -> None:
    """The gaps between the views in the embedding."""
    if not gaps:
        return
    table = _table("view gap: cosines with their 5 to 95 %, distance of means in spreads")
    for heading in ("task", "true pairs", "other pairs", "distance"):
        table.add_column(heading, justify="left" if heading == "task" else "right", no_wrap=True)
    for gap in gaps:
        cosines = (
            f"{of['mean']:.3f} ({of['low']:.2f} to {of['high']:.2f})"
            for of in (gap["true"], gap["other"])
        )
        table.add_row(gap["task"], *cosines, f"{gap['distance']:.3f}")
    results.print(table)


def print_groups(rows: Sequence[dict[str, Any]], first: str) -> None:
    """Metrics by number of views, by group or by part."""
    headings = dict.fromkeys((row["task"], row.get("by", "views a query")) for row in rows)
    for task, heading in headings:
        table = _table(task)
        for column in (heading, "R@1", "95 %", "AP", "95 %", "queries"):
            table.add_column(column, justify="right", no_wrap=True)
        for row in rows:
            if (row["task"], row.get("by", "views a query")) == (task, heading):
                cells = (
                    cell
                    for name in ("r1", "ap")
                    for cell in (f"{100 * row[name]:.2f}", _interval(row, name))
                )
                table.add_row(str(row[first]), *cells, f"{row['queries']:,}")
        results.print(table)


def _task(row: dict[str, Any]) -> str:
    return str(row["task"]) + ("\n  multi-query" if row["multi_query"] else "")


def _interval(row: dict[str, Any], measure: str) -> str:
    low, high = row.get(f"{measure}_low"), row.get(f"{measure}_high")
    return "-" if low is None or high is None else f"{100 * low:.2f} to {100 * high:.2f}"


def _table(title: str) -> Table:
    return Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
