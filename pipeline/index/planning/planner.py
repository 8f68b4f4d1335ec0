"""From a table to the plan of its index: candidates are tried on a sample of its vectors until one
is expected to reach the recall; where limits of time are given, all are tried.

In: the settings of the build, the table. Out: a Decision: the plan, what was rejected and why, and
the Pareto front of what was tried.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from rich.console import Console
from rich.table import Table

from pipeline.features.row_reader import supports_row_reads
from pipeline.features.table import FeatureTable
from pipeline.index.planning.choice import (
    PlanTrial,
    choose,
    figures,
    pareto_front,
    plan_label,
    reaches,
    rejection,
)
from pipeline.index.planning.families import EXACT, Refine
from pipeline.index.planning.plan import (
    GallerySpec,
    IndexPlan,
    candidate_plans,
    plan_factory,
    plan_index,
)
from pipeline.index.planning.trial import take_sample, trial_rows, try_plan
from pipeline.index.settings import IndexSettings, parse_bytes
from pipeline.index.train import SPECTRUM_ROWS, effective_dimension, sample_rows

FRONT_COLUMNS = {
    "plan": "plan",
    "nprobe or ef": "nprobe_or_ef",
    "candidates": "rerank_factor",
    "recall@10": "recall_at_10",
    "queries/s": "queries_per_second",
    "p99 ms": "p99_ms",
    "bytes a row": "bytes_per_row",
    "built in s": "build_seconds",
}
"Headings of the printed Pareto front, with the names of the figures."


@dataclass(frozen=True, kw_only=True)
class Decision:
    """The plan of an index, and how it was found."""

    plan: IndexPlan
    rejected: dict[str, str]
    "Label of each plan that was rejected -> why."
    failed: dict[str, str]
    "Those of them that were built and missed the recall."
    front: tuple[dict[str, Any], ...] = ()
    "Figures of the tried plans that no other beats in everything."
    sample_rows: int = 0
    "Rows that they were tried on; 0: nothing was tried."
    promised: bool = True
    "Whether the plan is expected to reach the recall."


def gallery_spec(
    settings: IndexSettings, table: FeatureTable, rows_of_part: dict[str, int]
) -> GallerySpec:
    """What is to be indexed, and within which limits; with the directions that count."""
    gallery = GallerySpec(
        rows=sum(rows_of_part.values()),
        dimension=table.dimension,
        budget=parse_bytes(settings.memory_budget),
        target_recall=settings.target_recall,
        rows_readable=supports_row_reads(table.path),
        workers=settings.workers,
        p99_ms=settings.p99_ms,
        batch=settings.batch,
        build_seconds=None if settings.build_minutes is None else 60 * settings.build_minutes,
        selectivity=settings.selectivity,
    )
    plan = plan_index(gallery)
    if settings.factory or not plan.training_rows:
        return gallery
    _, sample_SD = sample_rows(table, rows_of_part, min(SPECTRUM_ROWS, plan.training_rows))
    return replace(gallery, effective_dimension=effective_dimension(sample_SD))


class Planner:
    """Tries the plans of one gallery, each at most once."""

    def __init__(
        self, settings: IndexSettings, table: FeatureTable, rows_of_part: dict[str, int]
    ) -> None:
        """Raises InputError where no plan fits the memory."""
        self._table, self._rows_of_part = table, rows_of_part
        self.gallery = gallery_spec(settings, table, rows_of_part)
        if settings.factory:
            refine: Refine = "table" if settings.refine else "none"
            self._plans = [plan_factory(self.gallery, settings.factory, refine)]
        else:
            self._plans = candidate_plans(self.gallery)
        self._given = settings.factory is not None
        self._trials: dict[str, PlanTrial] = {}
        limits = (settings.p99_ms, settings.build_minutes)
        self._all = settings.dry_run or limits != (None, None) or settings.selectivity < 1

    def decide(self, failed: dict[str, str]) -> Decision | None:
        """The plan to build; None where none is left. `failed`: labels of plans that were built and
        missed the recall, with what they reached.

        Raises InputError where no plan keeps the limits of latency and time to build.
        """
        plans = [plan for plan in self._plans if plan_label(plan) not in failed]
        if not plans:
            return None
        first = plans[0]
        exact = first.factory == EXACT.form and not self._all
        if exact or (self._given and not self._all):
            return Decision(plan=first, rejected=failed, failed=failed)
        trials = self._try(plans)
        chosen = choose(trials, self.gallery)
        front = [figures(pair) for pair in pareto_front(self._trials.values())]
        return Decision(
            plan=chosen[0].plan,
            rejected=failed
            | {
                plan_label(trial.plan): rejection(trial, self.gallery, chosen)
                for trial in trials
                if trial is not chosen[0]
            },
            failed=failed,
            front=tuple(front),
            sample_rows=chosen[0].sample_rows,
            promised=chosen[1].recall >= self.gallery.target_recall,
        )

    def _try(self, plans: Sequence[IndexPlan]) -> list[PlanTrial]:
        """Trials of the plans: of all where limits are given, else up to the first that is expected
        to reach the recall.
        """
        trials: list[PlanTrial] = []
        sample = take_sample(self._table, self._rows_of_part, trial_rows(self.gallery))
        for plan in plans:
            label = plan_label(plan)
            if label not in self._trials:
                self._trials[label] = try_plan(plan, self.gallery, sample)
            trials.append(self._trials[label])
            if not self._all and reaches(trials[-1], self.gallery):
                break
        return trials


def print_decision(decision: Decision, rows: int, console: Console) -> None:
    """Print the plan for so many rows, what was rejected and why, and the Pareto front."""
    plan = decision.plan
    memory = f"; {plan.bytes / 1e9:.2f} GB of memory" if plan.bytes else ""
    for label, why in decision.rejected.items():
        console.print(f"rejected {label}: {why}")
    if decision.front:
        table = Table(title=f"tried on {decision.sample_rows:,} rows, expected at {rows:,} rows")
        for heading in FRONT_COLUMNS:
            table.add_column(heading, justify="left" if heading == "plan" else "right")
        for row in decision.front:
            table.add_row(*(str(row[name]) for name in FRONT_COLUMNS.values()))
        console.print(table)
    console.print(f"{plan_label(plan)}: {plan.reason}{memory}")
