"""Evaluate features exactly: every task that a table allows (--table), or one of two tables
(--queries and --gallery)

Writes metrics.json, metrics.parquet, queries.parquet, views.json, parts.json, view_gap.json and
report.html to --out, with the files that --by, --exports and --figures ask for, and prints the
metrics in percent.
"""

from jobs.command_line.cli import run
from pipeline.evaluation.settings import EvaluationSettings


def main(settings: EvaluationSettings, published: bool = False) -> None:
    """Rank queries against galleries and measure: Recall@K and AP, official protocol first.

    Args:
        settings: What to evaluate.
        published: Print the figures that papers published for University-1652's official test too.
    """
    from jobs.stages.evaluation_tables import evaluate_and_print

    evaluate_and_print(settings, published)


if __name__ == "__main__":
    run(main)
