"""Many methods on one test: evaluations of each seed in; rows with intervals and differences out.

The first method is the baseline. A query's figures are the mean over a method's seeds; intervals
and differences resample the places (retrieval/bootstrap.py).
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pipeline.core.arrays import Doubles, Strings
from pipeline.core.errors import InputError
from pipeline.evaluation.compare import MAIN_TASKS, TASK_HEADINGS, metric_by_query, rows_by_query
from pipeline.evaluation.published import impossible_means
from pipeline.report.inputs import EvaluationResults
from pipeline.retrieval.bootstrap import Difference, confidence_intervals, paired_difference


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a method costs."""

    parameters: int
    "Of the encoder."
    gmac: float
    "Billions of multiplications and additions for an image."
    numbers: int
    "Length of an image's embedding."
    images_per_second: float
    "In training, of both views."
    minutes: float
    "Of training."


@dataclass(frozen=True, kw_only=True)
class TaskFigures:
    """One direction: shares, with R@1's 95 % interval and its difference to the baseline."""

    task: str
    r1: float
    low: float
    high: float
    ap: float
    by_seed: tuple[float, ...]
    "R@1 of each seed."
    difference: Difference | None
    "None for the baseline itself."
    impossible: bool
    "R@1 and AP contradict each other, which they cannot where both were measured."


@dataclass(frozen=True, kw_only=True)
class LeaderboardRow:
    """One method."""

    method: str
    seeds: int
    tasks: tuple[TaskFigures, ...]
    cost: Cost

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON and the page."""
        return asdict(self)


def leaderboard(
    evaluations: Mapping[str, Sequence[EvaluationResults]], costs: Mapping[str, Cost]
) -> list[LeaderboardRow]:
    """A row per method, in their order.

    Raises InputError where two evaluations ranked other queries.
    """
    baseline = next(iter(evaluations))
    known = {method: _figures(runs) for method, runs in evaluations.items()}
    rows = []
    for method, by_task in known.items():
        tasks = []
        for task, (hit_SQ, ap_SQ, places_Q) in by_task.items():
            base = known[baseline].get(task)
            if base is not None and not np.array_equal(base[2], places_Q):
                raise InputError(
                    f"{method} and {baseline} ranked different queries for {task}; expected the "
                    "same images; evaluate both on the same shards"
                )
            hit_Q, ap_Q = hit_SQ.mean(0), ap_SQ.mean(0)
            low, high = confidence_intervals(hit_Q[:, None], places_Q)[:, 0]
            compared = None
            if method != baseline and base is not None:
                compared = paired_difference(hit_Q, base[0].mean(0), places_Q)
            r1, ap = float(hit_Q.mean()), float(ap_Q.mean())
            tasks.append(
                TaskFigures(
                    task=task, r1=r1, low=float(low), high=float(high), ap=ap,
                    by_seed=tuple(hit_SQ.mean(1).tolist()), difference=compared,
                    impossible=impossible_means(hit_SQ, ap_SQ),
                )
            )  # fmt: skip
        runs = evaluations[method]
        rows.append(
            LeaderboardRow(method=method, seeds=len(runs), tasks=tuple(tasks), cost=costs[method])
        )
    return rows


def _figures(runs: Sequence[EvaluationResults]) -> dict[str, tuple[Doubles, Doubles, Strings]]:
    """By task: hits and AP of each seed and query (S, Q), and the queries' places (Q,)."""
    found = {}
    for base in runs[0].metrics:
        if base["multi_query"] or base["task"] not in MAIN_TASKS:
            continue
        tables = [rows_by_query(run, base) for run in runs]
        places_Q = np.asarray(tables[0]["location"].to_pylist(), np.str_)
        hits, aps = (
            np.stack([metric_by_query(table, metric) for table in tables])
            for metric in ("r1", "ap")
        )
        found[base["task"]] = (hits, aps, places_Q)
    return found


def leaderboard_markdown(rows: Sequence[LeaderboardRow]) -> str:
    """One table, best R@1 of the first task first."""
    tasks = [figures.task for figures in rows[0].tasks]
    heads = [
        f"{TASK_HEADINGS[task]} {head}"
        for task in tasks
        for head in ("R@1 [95 %]", "AP", f"to {rows[0].method} (p)")
    ]
    lines = [
        f"| method | seeds | {' | '.join(heads)} "
        "| parameters | GMAC | numbers | images/s | minutes |",
        "|---|---:|" + "---:|" * (len(heads) + 5),
    ]
    for row in sorted(rows, key=lambda row: -row.tasks[0].r1):
        cells = [cell for figures in row.tasks for cell in _cells(figures)]
        cost = row.cost
        lines.append(
            f"| {row.method} | {row.seeds} | {' | '.join(cells)} | {cost.parameters / 1e6:.1f} M | "
            f"{cost.gmac:.2f} | {cost.numbers:,} | {cost.images_per_second:.0f} | "
            f"{cost.minutes:.1f} |"
        )
    return "\n".join(lines) + "\n"


def _cells(figures: TaskFigures) -> list[str]:
    change = figures.difference
    mark = " impossible" if figures.impossible else ""
    return [
        f"{figures.r1:.1%} [{figures.low:.1%}, {figures.high:.1%}]",
        f"{figures.ap:.1%}{mark}",
        f"{100 * change.mean:+.1f} ({change.p:.3f})" if change else "baseline",
    ]
