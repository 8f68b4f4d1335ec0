"""Evaluate features exactly: every task that a table allows (--table), or one of two tables (--queries and --gallery).

Writes metrics.json, metrics.parquet, queries.parquet, views.json and report.html to --out, what --by and --exports ask for
beside them, and prints the measures in percent.
"""

from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from jobs.cli import run
from pipeline import storage
from pipeline.evaluation import EvaluationSettings, evaluate
from pipeline.evaluation_files import GROUPS, VIEWS
from pipeline.published import ABLATION, TABLE

MEASURES = {"r1": "R@1", "r5": "R@5", "r10": "R@10", "r1p": "R@1%", "ap": "AP"}


def main(settings: EvaluationSettings, published: bool = False) -> None:
    """Rank queries against galleries and measure: Recall@K and AP, official protocol first.

    Args:
        settings: What to evaluate.
        published: Print the figures that papers published for University-1652's official test beside ours.
    """
    rows = evaluate(settings)
    print_table(rows, published)
    print_positions(rows)
    for name, first in ((VIEWS, "views"), (GROUPS, "value")):
        path = storage.join(settings.out, name)
        if storage.exists(path):
            print_groups(storage.read_json(path), first)


def print_table(rows: list[dict[str, Any]], beside: bool = False) -> None:
    """The measures of one evaluation on standard output, in percent, R@1 and AP with their 95 % intervals."""
    table = _table(f"{rows[0]['protocol']} protocol, percent; 95 % intervals over locations")
    table.add_column("task")
    for heading in (*MEASURES.values(), "queries", "gallery"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        name = row["task"] + ("\n  multi-query" if row["multi_query"] else "")
        counts = (f"{row['queries']:,}", f"{row['gallery']:,}")
        table.add_row(name, *(_figure(row, measure) for measure in MEASURES), *counts)
    for task in dict.fromkeys(row["task"] for row in rows if not row["multi_query"]) if beside else ():
        counts = ("37,855", "951") if task.startswith("drone") else ("701", "51,355")
        for line in (*TABLE, *ABLATION):
            if figures := line.of(task):
                name = f"{task}\n  {line.method} {line.pixels} px (published)"
                table.add_row(name, f"{figures[0]:.2f}", "", "", "", f"{figures[1]:.2f}", *counts)
    Console().print(table)


def print_positions(rows: list[dict[str, Any]]) -> None:
    """How far off the best answers are, where positions are known."""
    known = [row for row in rows if row.get("geo_queries")]
    if not known:
        return
    table = _table("distance of the best answer")
    for heading in ("task", "median", "within 25 m", "50 m", "100 m", "SDM@1", "SDM@3", "SDM@5", "queries"):
        table.add_column(heading, justify="left" if heading == "task" else "right", no_wrap=True)
    for row in known:
        shares = (f"{100 * row[f'within_{metres}m']:.2f}" for metres in (25, 50, 100))
        marks = ("-" if row[f"sdm{k}"] is None else f"{100 * row[f'sdm{k}']:.2f}" for k in (1, 3, 5))
        table.add_row(row["task"], f"{row['distance_median_m']:.1f} m", *shares, *marks, f"{row['geo_queries']:,}")
    Console().print(table)


def print_groups(rows: list[dict[str, Any]], first: str) -> None:
    """Measures by number of views or by group."""
    headings = dict.fromkeys((row["task"], row.get("by", "views a query")) for row in rows)
    for task, heading in headings:
        table = _table(task)
        for column in (heading, "R@1", "AP", "queries"):
            table.add_column(column, justify="right", no_wrap=True)
        for row in rows:
            if (row["task"], row.get("by", "views a query")) == (task, heading):
                table.add_row(str(row[first]), _figure(row, "r1"), _figure(row, "ap"), f"{row['queries']:,}")
        Console().print(table)


def _figure(row: dict[str, Any], measure: str) -> str:
    text = f"{100 * row[measure]:.2f}"
    if measure in ("r1", "ap") and row.get(f"{measure}_low") is not None:
        text += f"\n{100 * row[f'{measure}_low']:.1f}–{100 * row[f'{measure}_high']:.1f}"
    return text


def _table(title: str) -> Table:
    return Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))


if __name__ == "__main__":
    run(main)
