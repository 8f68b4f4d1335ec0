"""What an evaluation holds besides measures and report: R@1 by views, measures by group and by
part, the gap between the views, files for other programs.

In: the tables and the per-query rows. Out: `views.json` (rows of view_curve.VIEWS_SCHEMA),
`groups.json` (rows of breakdowns.break_down), `parts.json` (rows of part_measures.measure_parts),
`view_gap.json` (of each pair of views view_gap.describe), `answer.txt` and `pytorch_result.mat`,
one of each task where there are several.
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
    """What to write; each field as in evaluation.EvaluationSettings."""

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
    wanted: ExtraOutputs,
    queries: FeatureTable,
    gallery: FeatureTable,
    tasks: list[Task],
    results: pa.Table,
) -> None:
    """Write what was asked for.

    Raises InputError when a column or a name is not known, or features do not fit a .mat file.
    """
    single = [task for task in tasks if not task.multi_query]
    several = [
        task
        for task in single
        if (task.query_view, task.gallery_view) == (View.DRONE, View.SATELLITE)
    ]
    if wanted.views and several:
        with progress(None, "by number of views", "scores") as meter:
            curve = measure_views(
                several[0], queries, gallery, wanted.protocol, wanted.workers, meter.advance
            )
        if curve:
            storage.write_json(storage.join(wanted.out, VIEWS_FILE), curve)
    if wanted.by and wanted.shards:
        groups: list[dict[str, Any]] = []
        for column in wanted.by:
            groups += breakdowns.break_down(
                results, column, breakdowns.read_column(wanted.shards, column)
            )
        storage.write_json(storage.join(wanted.out, GROUPS_FILE), groups)
    if wanted.parts:
        with progress(None, "by part of the embedding", "scores") as meter:
            parts = [
                row
                for task in single
                for row in measure_parts(
                    task, queries, gallery, wanted.protocol, wanted.workers, meter.advance
                )
            ]
        if parts:
            storage.write_json(storage.join(wanted.out, PARTS_FILE), parts)
    if gaps := _gaps(single, queries, gallery):
        storage.write_json(storage.join(wanted.out, GAP_FILE), gaps)
    for task in single:
        _export(
            wanted,
            task,
            f"-{task.query_view}-{task.gallery_view}" if len(single) > 1 else "",
            queries,
            gallery,
            results,
        )


def _gaps(tasks: list[Task], queries: FeatureTable, gallery: FeatureTable) -> list[dict[str, Any]]:
    """Of each pair of views the gap, once, whichever asks for the other; none where they have not
    two places in common.
    """
    gaps: dict[frozenset[View], dict[str, Any]] = {}
    for task in tasks:
        views = frozenset((task.query_view, task.gallery_view))
        if views in gaps:
            continue
        sides = task_embedding_sets(task, queries, gallery, "full")
        rows = view_gap.choose_common_rows(sides[0].locations, sides[1].locations)
        asked, given = (take_rows(side, rows_N) for side, rows_N in zip(sides, rows, strict=True))
        if len(np.unique(asked.locations_N)) > 1:
            gaps[views] = {"task": task.name} | view_gap.describe_gap(asked, given)
    return list(gaps.values())


def _export(
    wanted: ExtraOutputs,
    task: Task,
    ending: str,
    queries: FeatureTable,
    gallery: FeatureTable,
    results: pa.Table,
) -> None:
    if "mat" in wanted.exports:
        data = exports.mat_bytes(queries, gallery, task.query_view, task.gallery_view)
        storage.write_bytes(storage.join(wanted.out, f"pytorch_result{ending}.mat"), data)
    if "answer" in wanted.exports:
        mask = pc.and_(pc.equal(results["task"], task.name), pc.invert(results["multi_query"]))
        names = exports.source_file_names(wanted.shards) if wanted.shards else None
        order = exports.read_answer_order(wanted.answer_order) if wanted.answer_order else None
        text = exports.answer_text(results.filter(mask).to_pylist(), names, order)
        storage.write_bytes(storage.join(wanted.out, f"answer{ending}.txt"), text.encode())
