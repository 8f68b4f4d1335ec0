"""What the report shows, read from finished folders: an evaluation, the one beside it, the training
run's curves.
"""

import hashlib
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from pipeline.core import parquet, storage
from pipeline.core.errors import InputError
from pipeline.features.table import Floats
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
"Embeddings (D,) by key; keys that are not known are absent."
REQUIRED_COLUMNS = frozenset({"query", "task", "protocol", "multi_query", "first_match_rank", "ap"})
"Columns of a result that are always there."
EXTRA_FILES = {"views": VIEWS_FILE, "groups": GROUPS_FILE, "parts": PARTS_FILE, "gaps": GAP_FILE}


def no_vectors(keys: Iterable[str]) -> dict[str, Floats]:
    return {}


@dataclass(frozen=True, kw_only=True)
class EvaluationResults:
    """One evaluation."""

    name: str
    metrics: list[dict[str, Any]]
    "Rows of retrieval.METRICS_SCHEMA."
    results: pa.Table
    "Rows of retrieval.RESULTS_SCHEMA, of all tasks."
    views: tuple[dict[str, Any], ...] = ()
    "Rows of view_curve.VIEWS_SCHEMA."
    groups: tuple[dict[str, Any], ...] = ()
    "Rows of breakdowns.break_down."
    parts: tuple[dict[str, Any], ...] = ()
    "Rows of part_measures.measure_parts."
    gaps: tuple[dict[str, Any], ...] = ()
    "Of each pair of views view_gap.describe."

    def of(self, row: dict[str, Any]) -> dict[str, Any] | None:
        """This evaluation's metric row for the task of another's row; None where it has none.

        Raises InputError when the two ranked different numbers of images, which no difference of
        figures survives.
        """
        for own in self.metrics:
            if task_key(own) == task_key(row):
                if (own["queries"], own["gallery"]) != (row["queries"], row["gallery"]):
                    raise InputError(
                        f"{self.name} ranked {own['queries']} queries in {own['gallery']} rows for {own['task']}, this "
                        f"evaluation {row['queries']} in {row['gallery']}; expected the same images; embed and evaluate "
                        "both on the same shards"
                    )
                return own
        return None

    def results_of(self, row: dict[str, Any]) -> list[dict[str, Any]]:
        """The per-query rows of a metric row's task."""
        mask = pc.equal(self.results["multi_query"], row["multi_query"])
        for name in ("task", "protocol"):
            mask = pc.and_(mask, pc.equal(self.results[name], row[name]))
        rows: list[dict[str, Any]] = self.results.filter(mask).to_pylist()
        return rows


def task_key(row: dict[str, Any]) -> tuple[str, str, bool]:
    return row["task"], row["protocol"], row["multi_query"]


def read_evaluation(folder: str) -> EvaluationResults:
    """A finished evaluation.

    Raises InputError when there is none.
    """
    if not storage.exists(storage.join(folder, METRICS_FILE)):
        raise InputError(
            f"no finished evaluation at {folder}: found no metrics.json; make one with jobs/evaluate.py"
        )
    path = storage.join(folder, RESULTS_FILE)
    try:
        results = parquet.read_table(path)
    except parquet.DAMAGE_ERRORS as error:
        raise InputError(
            f"{path} cannot be read ({error}), expected the rows of a finished evaluation; delete {folder} and evaluate again "
            "with jobs/evaluate.py"
        ) from None
    metrics = read_result_rows(folder, METRICS_FILE)
    if not set(results.column_names) >= REQUIRED_COLUMNS or not all(
        _is_measured(row) for row in metrics
    ):
        raise InputError(
            f"the evaluation at {folder} holds rows or columns that jobs/evaluate.py does not write; delete {folder} and "
            "evaluate again with jobs/evaluate.py"
        )
    return EvaluationResults(
        name=folder.rstrip("/").rsplit("/", 1)[-1],
        metrics=metrics,
        results=results,
        **read_extras(folder),
    )


def _is_measured(row: dict[str, Any]) -> bool:
    """Whether this is a row of metrics.json as whoever compares and shows them needs it."""
    return (
        all(isinstance(row.get(name), str) for name in ("task", "protocol"))
        and all(type(row.get(name)) is int for name in ("queries", "gallery"))
        and all(type(row.get(name)) in (int, float) for name in ("r1", "r5", "r10", "r1p", "ap"))
        and isinstance(row.get("multi_query"), bool)
    )


def read_extras(folder: str) -> dict[str, tuple[dict[str, Any], ...]]:
    """What an evaluation holds besides its measures, by the names of Findings' fields; empty where
    it was not taken.

    Raises InputError where a file is not what was written.
    """
    return {name: tuple(read_result_rows(folder, file)) for name, file in EXTRA_FILES.items()}


@dataclass(frozen=True, kw_only=True)
class ReportContext:
    """What the report shows besides the evaluation itself."""

    title: str
    beside: EvaluationResults | None = None
    training: tuple[dict[str, Any], ...] = ()
    "Rows of the run's metrics.jsonl, one per epoch."

    @property
    def sha256(self) -> str:
        """Hash of all of it: the same extras give the same page."""
        other = self.beside
        beside = (
            [other.name, other.metrics, other.results.to_pydict(), other.gaps] if other else None
        )
        return hashlib.sha256(json.dumps([self.title, beside, self.training]).encode()).hexdigest()


def read_report_context(title: str, run: str | None, beside: str | None) -> ReportContext:
    """Read what was named.

    Raises InputError when a folder does not hold what it should.
    """
    return ReportContext(
        title=title,
        beside=read_evaluation(beside) if beside else None,
        training=tuple(read_training(run)) if run else (),
    )


def read_training(run: str) -> list[dict[str, Any]]:
    """A training run's rows by epoch; of an epoch that was trained twice (after a restart) the
    later one.

    Raises InputError when there are none.
    """
    path = storage.join(run, "metrics.jsonl")
    if not storage.exists(path):
        raise InputError(
            f"no training curves at {run}: found no metrics.jsonl; expected the --out of jobs/train.py"
        )
    lines = storage.read_bytes(path).decode(errors="replace").splitlines()
    by_epoch: dict[int, dict[str, Any]] = {}
    for number, line in enumerate(lines, 1):
        try:
            row = json.loads(line)
            by_epoch[int(row["epoch"])] = row
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
            if number == len(lines):
                break  # a run that is still writing, or was killed while it wrote
            raise InputError(
                f"line {number} of {path} is {line[:60]!r}; expected a JSON object with its epoch; mend or delete the line"
            ) from None
    return [by_epoch[epoch] for epoch in sorted(by_epoch)]
