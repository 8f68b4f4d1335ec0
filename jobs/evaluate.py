"""Evaluate features exactly: every task that a table allows (--table), or one of two tables (--queries and --gallery).

Writes metrics.json, metrics.parquet, queries.parquet and report.html to --out and prints the measures in percent.
"""

from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from jobs.cli import run
from pipeline.evaluation import EvaluationSettings, evaluate

MEASURES = {"r1": "R@1", "r5": "R@5", "r10": "R@10", "r1p": "R@1%", "ap": "AP"}


def main(settings: EvaluationSettings) -> None:
    """Rank queries against galleries and measure: Recall@K and AP, official protocol first."""
    print_table(evaluate(settings))


def print_table(rows: list[dict[str, Any]]) -> None:
    """The measures of one evaluation on standard output, in percent."""
    table = Table(title=f"{rows[0]['protocol']} protocol, percent", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("task")
    for heading in (*MEASURES.values(), "queries", "gallery"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        name = row["task"] + ("\n  multi-query" if row["multi_query"] else "")
        counts = (f"{row['queries']:,}", f"{row['gallery']:,}")
        table.add_row(name, *(f"{100 * row[measure]:.2f}" for measure in MEASURES), *counts)
    Console().print(table)


if __name__ == "__main__":
    run(main)
