"""The extra outputs of an evaluation: R@1 by views, metrics by group and by part, the gap between
the views, files for other programs.

In: the tables and the per-query rows. Out: `views.json` (rows of views.VIEWS_SCHEMA), `groups.json`
(rows of breakdowns.break_down), `parts.json` (rows of parts.measure_parts), `view_gap.json` (a
view_gap.describe_gap for each pair of views), `answer.txt` and `pytorch_result.mat`, one of each
per task if there are several.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.core import storage
from pipeline.core.progress import progress
from pipeline.core.records import View
from pipeline.evaluation import breakdowns, exports
from pipeline.evaluation.settings import ExportFormat
from pipeline.features.table import FeatureTable
from pipeline.retrieval import view_gap
from pipeline.retrieval.metrics import Protocol
from pipeline.retrieval.parts import measure_parts
from pipeline.retrieval.results import GAP_FILE, GROUPS_FILE, PARTS_FILE, VIEWS_FILE
from pipeline.retrieval.subsets import take_rows
from pipeline.retrieval.tasks import Task, task_embedding_sets
from pipeline.retrieval.views import measure_views
from pipeline.shards.shard_set import ShardSet


@dataclass(frozen=True, kw_only=True)
class ExtraOutputs:
    """What to write; each field as in settings.EvaluationSettings."""

    out: str
    protocol: Protocol
    workers: int
    views: bool
    parts: bool
    by: tuple[str, ...]
    exports: tuple[ExportFormat, ...]
    shards: ShardSet | None
    answer_order: str | None


def write_extras(
    outputs: ExtraOutputs,
    queries: FeatureTable,
    gallery: FeatureTable,
    tasks: list[Task],
    results: pa.Table,
) -> None:
    """Write the extras that were asked for. `results`: rows of tasks.RESULTS_SCHEMA.

    Raises InputError if a column or a name is unknown, or features do not fit a .mat file.
    """
    single = [task for task in tasks if not task.multi_query]
    if outputs.by and outputs.shards is not None:
        groups: list[dict[str, Any]] = []
        for column in outputs.by:
            values = breakdowns.read_column(outputs.shards, column)
            groups += breakdowns.break_down(results, column, values)
        storage.write_json(storage.join(outputs.out, GROUPS_FILE), groups)
    files = {
        VIEWS_FILE: _view_rows(outputs, single, queries, gallery),
        PARTS_FILE: _part_rows(outputs, single, queries, gallery),
        GAP_FILE: _gap_rows(single, queries, gallery),
    }
    for name, rows in files.items():
        if rows:
            storage.write_json(storage.join(outputs.out, name), rows)
    for task in single:
        suffix = f"-{task.query_view}-{task.gallery_view}" if len(single) > 1 else ""
        _export(outputs, task, suffix, queries, gallery, results)


def _view_rows(
    outputs: ExtraOutputs, tasks: list[Task], queries: FeatureTable, gallery: FeatureTable
) -> list[dict[str, Any]]:
    """R@1 and AP of drone->satellite by views per query."""
    drone_to_satellite = Task(query_view=View.DRONE, gallery_view=View.SATELLITE)
    if not outputs.views or drone_to_satellite not in tasks:
        return []
    with progress(None, "by number of views", "scores") as meter:
        return measure_views(
            drone_to_satellite, queries, gallery, outputs.protocol, outputs.workers, meter.advance
        )


def _part_rows(
    outputs: ExtraOutputs, tasks: list[Task], queries: FeatureTable, gallery: FeatureTable
) -> list[dict[str, Any]]:
    """Metrics of all tasks by part of the embedding."""
    if not outputs.parts:
        return []
    with progress(None, "by part of the embedding", "scores") as meter:
        return [
            row
            for task in tasks
            for row in measure_parts(
                task, queries, gallery, outputs.protocol, outputs.workers, meter.advance
            )
        ]


def _gap_rows(
    tasks: list[Task], queries: FeatureTable, gallery: FeatureTable
) -> list[dict[str, Any]]:
    """The gap of each pair of views, once for both directions; none if the views have fewer than
    two places in common.
    """
    gaps: dict[frozenset[View], dict[str, Any]] = {}
    for task in tasks:
        views = frozenset((task.query_view, task.gallery_view))
        if views in gaps:
            continue
        query_set, gallery_set = task_embedding_sets(task, queries, gallery, "full")
        rows = view_gap.choose_common_rows(query_set.locations, gallery_set.locations)
        query_rows, gallery_rows = take_rows(query_set, rows[0]), take_rows(gallery_set, rows[1])
        if len(np.unique(query_rows.locations_N)) > 1:
            gaps[views] = {"task": task.name} | view_gap.describe_gap(query_rows, gallery_rows)
    return list(gaps.values())


def _export(
    outputs: ExtraOutputs,
    task: Task,
    suffix: str,
    queries: FeatureTable,
    gallery: FeatureTable,
    results: pa.Table,
) -> None:
    """Write the files for other programs of one task."""
    if "mat" in outputs.exports:
        data = exports.mat_bytes(queries, gallery, task.query_view, task.gallery_view)
        storage.write_bytes(storage.join(outputs.out, f"pytorch_result{suffix}.mat"), data)
    if "answer" in outputs.exports:
        mask = pc.and_(pc.equal(results["task"], task.name), pc.invert(results["multi_query"]))
        names = exports.source_file_names(outputs.shards) if outputs.shards else None
        order = exports.read_answer_order(outputs.answer_order) if outputs.answer_order else None
        text = exports.answer_text(results.filter(mask).to_pylist(), names, order)
        storage.write_bytes(storage.join(outputs.out, f"answer{suffix}.txt"), text.encode())
