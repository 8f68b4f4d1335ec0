"""Reads what the report shows: an evaluation, the one beside it, the curves of a training run.

In: finished folders. Out: an `EvaluationResults`, and a `ReportContext` with the rest.
"""

import hashlib
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from pipeline.core import parquet, storage
from pipeline.core.arrays import Floats
from pipeline.core.errors import InputError
from pipeline.retrieval.results import (
    GAP_FILE,
    GROUPS_FILE,
    METRICS_FILE,
    PARTS_FILE,
    RESULTS_FILE,
    VIEWS_FILE,
    read_result_rows,
)

VectorLoader = Callable[[Iterable[str]], dict[str, Floats]]
"Embeddings (D,) by key; unknown keys are absent."
REQUIRED_COLUMNS = frozenset({"query", "task", "protocol", "multi_query", "first_match_rank", "ap"})
"Columns that the per-query rows always have."
EXTRA_FILES = {"views": VIEWS_FILE, "groups": GROUPS_FILE, "parts": PARTS_FILE, "gaps": GAP_FILE}
"Optional files of an evaluation, by the field of `EvaluationResults` that holds their rows."


def no_vectors(keys: Iterable[str]) -> dict[str, Floats]:
    """A vector loader that finds none."""
    return {}


@dataclass(frozen=True, kw_only=True)
class EvaluationResults:
    """One finished evaluation."""

    name: str
    metrics: list[dict[str, Any]]
    "Rows of tasks.METRICS_SCHEMA."
    results: pa.Table
    "Rows of tasks.RESULTS_SCHEMA, of all tasks."
    views: tuple[dict[str, Any], ...] = ()
    "Rows of views.VIEWS_SCHEMA."
    groups: tuple[dict[str, Any], ...] = ()
    "Rows of breakdowns.break_down."
    parts: tuple[dict[str, Any], ...] = ()
    "Rows of parts.measure_parts."
    gaps: tuple[dict[str, Any], ...] = ()
    "One view_gap.describe_gap for each pair of views."

    def metrics_for(self, row: dict[str, Any]) -> dict[str, Any] | None:
        """This evaluation's metric row for the task of another's row; None if it has none.

        Raises InputError if the two ranked different numbers of images: their figures cannot be
        compared.
        """
        for own in self.metrics:
            if task_key(own) == task_key(row):
                if (own["queries"], own["gallery"]) != (row["queries"], row["gallery"]):
                    raise InputError(
                        f"{self.name} ranked {own['queries']} queries in {own['gallery']} rows for "
                        f"{own['task']}, this evaluation {row['queries']} in {row['gallery']}; "
                        "expected the same images; embed and evaluate both on the same shards"
                    )
                return own
        return None

    def rows_for(self, row: dict[str, Any]) -> list[dict[str, Any]]:
        """The per-query rows of a metric row's task."""
        mask = pc.equal(self.results["multi_query"], row["multi_query"])
        for name in ("task", "protocol"):
            mask = pc.and_(mask, pc.equal(self.results[name], row[name]))
        rows: list[dict[str, Any]] = self.results.filter(mask).to_pylist()
        return rows


def task_key(row: dict[str, Any]) -> tuple[str, str, bool]:
    """What identifies a task among the metric rows of an evaluation."""
    return row["task"], row["protocol"], row["multi_query"]


def read_evaluation(folder: str) -> EvaluationResults:
    """Read a finished evaluation.

    Raises InputError if there is none, or its files are damaged.
    """
    if not storage.exists(storage.join(folder, METRICS_FILE)):
        raise InputError(
            f"no finished evaluation at {folder}: found no metrics.json; "
            "make one with jobs/evaluate.py"
        )
    path = storage.join(folder, RESULTS_FILE)
    try:
        results = parquet.read_table(path)
    except parquet.DAMAGE_ERRORS as error:
        raise InputError(
            f"{path} cannot be read ({error}), expected the rows of a finished evaluation; "
            f"delete {folder} and evaluate again with jobs/evaluate.py"
        ) from None
    metrics = read_result_rows(folder, METRICS_FILE)
    columns = set(results.column_names)
    if not columns >= REQUIRED_COLUMNS or not all(_is_metric_row(row) for row in metrics):
        raise InputError(
            f"the evaluation at {folder} holds rows or columns that jobs/evaluate.py does not "
            f"write; delete {folder} and evaluate again with jobs/evaluate.py"
        )
    return EvaluationResults(
        name=folder.rstrip("/").rsplit("/", 1)[-1],
        metrics=metrics,
        results=results,
        **read_extras(folder),
    )


def _is_metric_row(row: dict[str, Any]) -> bool:
    """Whether a row of metrics.json has every field that is compared and shown, with its type."""
    return (
        all(isinstance(row.get(name), str) for name in ("task", "protocol"))
        and all(type(row.get(name)) is int for name in ("queries", "gallery"))
        and all(type(row.get(name)) in (int, float) for name in ("r1", "r5", "r10", "r1p", "ap"))
        and isinstance(row.get("multi_query"), bool)
    )


def read_extras(folder: str) -> dict[str, tuple[dict[str, Any], ...]]:
    """The optional files of an evaluation, by `EvaluationResults`' fields; empty if a file was not
    written.

    Raises InputError if a file is damaged.
    """
    return {name: tuple(read_result_rows(folder, file)) for name, file in EXTRA_FILES.items()}


@dataclass(frozen=True, kw_only=True)
class ReportContext:
    """What the report shows in addition to the evaluation itself."""

    title: str
    beside: EvaluationResults | None = None
    training: tuple[dict[str, Any], ...] = ()
    "Rows of the run's metrics.jsonl, one per epoch."

    @property
    def sha256(self) -> str:
        """SHA-256 of all of it: the same context gives the same page."""
        other = self.beside
        beside = (
            [other.name, other.metrics, other.results.to_pydict(), other.gaps] if other else None
        )
        return hashlib.sha256(json.dumps([self.title, beside, self.training]).encode()).hexdigest()


def read_report_context(title: str, run: str | None, beside: str | None) -> ReportContext:
    """Read the folders of a training run and of another evaluation, where they are given.

    Raises InputError if a folder does not hold what it should.
    """
    return ReportContext(
        title=title,
        beside=read_evaluation(beside) if beside else None,
        training=tuple(read_training(run)) if run else (),
    )


def read_training(run: str) -> list[dict[str, Any]]:
    """A training run's rows by epoch; of an epoch that was trained twice (after a restart) the
    later one.

    Raises InputError if there are none.
    """
    path = storage.join(run, "metrics.jsonl")
    if not storage.exists(path):
        raise InputError(
            f"no training curves at {run}: found no metrics.jsonl; "
            "expected the --out of jobs/train.py"
        )
    lines = storage.read_bytes(path).decode(errors="replace").splitlines()
    by_epoch: dict[int, dict[str, Any]] = {}
    for number, line in enumerate(lines, 1):
        try:
            row = json.loads(line)
            by_epoch[int(row["epoch"])] = row
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
            if number == len(lines):
                break  # the run is still writing, or was killed while it wrote
            raise InputError(
                f"line {number} of {path} is {line[:60]!r}; expected a JSON object with its epoch; "
                "correct or delete the line"
            ) from None
    return [by_epoch[epoch] for epoch in sorted(by_epoch)]
