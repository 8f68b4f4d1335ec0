"""The evaluation stage: feature tables on disk -> metrics, per-query rows and the report in one
folder.

In: one table with query and gallery rows, or one table for each. Out: `queries.parquet`,
`metrics.parquet`, `report.html`, the files of evaluation/extras.py, `evaluation.json` (the inputs
of all of it, with checksums) and, last, `metrics.json`: once that file exists, the evaluation is
complete.
"""

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import pyarrow as pa

from pipeline.core import json_files, parquet, storage
from pipeline.core.arrays import Floats
from pipeline.core.errors import InputError
from pipeline.core.lock import locks_output
from pipeline.core.progress import console, progress
from pipeline.core.records import Split, View
from pipeline.evaluation.extras import ExtraOutputs, write_extras
from pipeline.evaluation.settings import EvaluationSettings
from pipeline.features.table import FeatureTable, open_table, verify_table
from pipeline.images.thumbnails import no_images
from pipeline.report.inputs import (
    EvaluationResults,
    ReportContext,
    read_evaluation,
    read_extras,
    read_report_context,
)
from pipeline.report.page import render_report
from pipeline.retrieval.embedding_set import embedding_set_from_table
from pipeline.retrieval.results import (
    INPUTS_FILE,
    METRICS_FILE,
    RESULTS_FILE,
    read_inputs,
    read_result_rows,
    results_intact,
    write_inputs,
)
from pipeline.retrieval.subsets import vectors_by_key
from pipeline.retrieval.tasks import METRICS_SCHEMA, Task, possible_tasks, retrieve
from pipeline.shards.shard_set import ShardSet, open_shards
from pipeline.shards.tile_reader import TileReader
from pipeline.shards.verify import require_intact

OUTPUT_SETTINGS = (
    "title",
    "shards",
    "panels",
    "views",
    "parts",
    "by",
    "exports",
    "figures",
    "answer_order",
)
"Settings that change what is written, but not the ranking."


@dataclass(frozen=True, kw_only=True)
class _Evaluation:
    """An evaluation with its inputs opened."""

    settings: EvaluationSettings
    queries: FeatureTable
    gallery: FeatureTable
    tasks: list[Task]
    shards: ShardSet | None
    context: ReportContext

    @property
    def inputs(self) -> dict[str, Any]:
        """The content of evaluation.json: `ranked` determines the ranking, `shown` the rest."""
        ranked = {
            "fingerprint": self.queries.fingerprint,
            "queries": self.queries.digest,
            "gallery": self.gallery.digest,
            "protocol": self.settings.protocol,
            "tasks": [str(task) for task in self.tasks],
        }
        shown = {name: _as_json(getattr(self.settings, name)) for name in OUTPUT_SETTINGS}
        return {"ranked": ranked, "shown": shown | {"extras": self.context.sha256}}


@locks_output(lambda settings: settings.out)
def evaluate(settings: EvaluationSettings) -> list[dict[str, Any]]:
    """Evaluate into `settings.out` and return the metric rows. A finished evaluation of the same
    inputs is a no-op; if only the outputs differ, they are written without ranking again.

    Raises InputError if the tables do not match or allow no task, or the folder holds another
    evaluation.
    """
    queries, gallery, tasks = plan_tasks(settings)
    # Opened before the ranking, so that a wrong folder is refused before hours of work.
    shards = open_shards(settings.shards) if settings.shards else None
    if shards is not None and settings.verify:
        require_intact(shards)
    evaluation = _Evaluation(
        settings=settings,
        queries=queries,
        gallery=gallery,
        tasks=tasks,
        shards=shards,
        context=read_report_context(settings.title, settings.run, settings.beside),
    )
    earlier = _load_earlier_inputs(settings.out, evaluation.inputs["ranked"])
    if earlier is None:
        _evaluate(evaluation)
    elif earlier["shown"] == evaluation.inputs["shown"]:
        console.print(
            f"{settings.out} is complete: the same features were evaluated before; nothing to do"
        )
    else:
        _rewrite_outputs(evaluation)
    return read_result_rows(settings.out, METRICS_FILE)


def plan_tasks(settings: EvaluationSettings) -> tuple[FeatureTable, FeatureTable, list[Task]]:
    """The two tables, and the tasks to evaluate them on.

    Raises InputError if they come from different networks, allow no task, or more tasks than the
    one that was asked for.
    """
    read = verify_table if settings.verify else open_table
    queries = read(settings.table or settings.queries or "")
    gallery = queries if settings.table else read(settings.gallery or "")
    if queries.fingerprint != gallery.fingerprint:
        raise InputError(
            f"queries were embedded by network {queries.fingerprint[:12]} and the gallery by "
            f"{gallery.fingerprint[:12]}; expected one; embed both with the same checkpoint "
            "(jobs/embed_gallery.py --checkpoint)"
        )
    possible = [
        task
        for task in possible_tasks(queries, gallery)
        if settings.query_view in (None, str(task.query_view))
        and settings.gallery_view in (None, str(task.gallery_view))
    ]
    if not possible:
        raise InputError(
            f"found {_describe_rows(queries, Split.QUERY)} and "
            f"{_describe_rows(gallery, Split.GALLERY)}; expected query rows of one view and "
            "gallery rows of another; embed both splits, or name other views with --query-view "
            "and --gallery-view"
        )
    if settings.table:
        drone_to_satellite = Task(query_view=View.DRONE, gallery_view=View.SATELLITE)
        merged = [
            replace(task, multi_query=True) for task in possible if task == drone_to_satellite
        ]
        return queries, gallery, possible + merged
    if len(possible) > 1:
        raise InputError(
            f"the tables allow {', '.join(task.name for task in possible)}; expected one task; "
            "choose with --query-view and --gallery-view, or give one --table for all of them"
        )
    return queries, gallery, [replace(possible[0], multi_query=settings.multi_query)]


def _load_earlier_inputs(out: str, ranked: dict[str, Any]) -> dict[str, Any] | None:
    """The inputs of a finished, intact evaluation in the folder; None if there is none.

    Raises InputError if the folder holds an evaluation of other tables.
    """
    if not storage.exists(storage.join(out, METRICS_FILE)):
        return None
    earlier = read_inputs(out)
    if earlier is None:
        raise InputError(
            f"{out} holds a {METRICS_FILE} without {INPUTS_FILE}; expected an evaluation's "
            f"folder; choose another --out or delete {out}"
        )
    if earlier["ranked"] != ranked:
        different = [name for name, value in ranked.items() if earlier["ranked"].get(name) != value]
        raise InputError(
            f"{out} holds an evaluation of something else (different {', '.join(different)}); "
            "expected the same or an empty folder; choose another --out"
        )
    if not results_intact(out, earlier):
        console.print(f"{out}: a file is missing or damaged; evaluating again", style="yellow")
        return None
    return earlier


def _evaluate(evaluation: _Evaluation) -> None:
    """Rank every task and write all files, `metrics.json` last."""
    begin, settings = time.monotonic(), evaluation.settings
    queries, gallery = evaluation.queries, evaluation.gallery
    if storage.exists(storage.join(settings.out, INPUTS_FILE)):
        storage.remove(storage.join(settings.out, INPUTS_FILE))  # of an unfinished run
    found, spent = [], {}
    for task in evaluation.tasks:
        started = time.monotonic()
        total = None  # unknown for merged queries and reduced galleries
        if settings.protocol == "full" and not task.multi_query:
            total = (
                queries.counts[Split.QUERY, task.query_view]
                * gallery.counts[Split.GALLERY, task.gallery_view]
            )
        with progress(total, str(task), "scores") as meter:
            found.append(
                retrieve(
                    task, queries, gallery, settings.protocol, None, meter.advance, settings.workers
                )
            )
        spent[str(task)] = time.monotonic() - started
    rows = [each.metrics for each in found]
    results = pa.concat_tables([each.queries for each in found])
    parquet.write_table(storage.join(settings.out, RESULTS_FILE), results)
    metrics_table = pa.Table.from_pylist(rows, METRICS_SCHEMA)
    parquet.write_table(storage.join(settings.out, "metrics.parquet"), metrics_table)
    started = time.monotonic()
    _write_extras(evaluation, results)
    spent["views, groups and exports"] = time.monotonic() - started
    started = time.monotonic()
    extras = read_extras(settings.out)
    evaluated = EvaluationResults(name=settings.title, metrics=rows, results=results, **extras)
    _write_report(evaluation, evaluated)
    spent["report"] = time.monotonic() - started
    metrics = storage.encode_json(rows)
    write_inputs(settings.out, evaluation.inputs, metrics)
    storage.write_bytes(storage.join(settings.out, METRICS_FILE), metrics)
    parts = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in spent.items())
    console.print(
        f"{storage.join(settings.out, METRICS_FILE)}: {time.monotonic() - begin:.1f} s ({parts})"
    )


def _rewrite_outputs(evaluation: _Evaluation) -> None:
    """Write the extras and the report again, from an earlier ranking."""
    out = evaluation.settings.out
    results = read_evaluation(out).results
    # Invalidate the inputs record until every file is rewritten, so that a crash here forces them
    # to be written again.
    json_files.write_checksummed(
        storage.join(out, INPUTS_FILE), {"ranked": evaluation.inputs["ranked"], "shown": {}}
    )
    _write_extras(evaluation, results)
    _write_report(evaluation, read_evaluation(out))
    write_inputs(out, evaluation.inputs)
    console.print(f"{out}: ranked before; rewrote report.html and the files that belong to it")


def _write_extras(evaluation: _Evaluation, results: pa.Table) -> None:
    settings = evaluation.settings
    outputs = ExtraOutputs(
        out=settings.out,
        protocol=settings.protocol,
        workers=settings.workers,
        views=settings.views,
        parts=settings.parts,
        by=settings.by,
        exports=settings.exports,
        shards=evaluation.shards,
        answer_order=settings.answer_order,
    )
    write_extras(outputs, evaluation.queries, evaluation.gallery, evaluation.tasks, results)


def _write_report(evaluation: _Evaluation, results: EvaluationResults) -> None:
    settings, shards = evaluation.settings, evaluation.shards
    tables = (evaluation.queries.select(Split.QUERY), evaluation.gallery.select(Split.GALLERY))

    def vectors(keys: Iterable[str]) -> dict[str, Floats]:
        wanted = set(keys)
        by_key: dict[str, Floats] = {}
        for table in tables:
            by_key |= vectors_by_key(embedding_set_from_table(table), wanted)
        return by_key

    images = no_images if shards is None else TileReader(shards).fetch
    page = render_report(results, evaluation.context, images, vectors, settings.panels)
    storage.write_bytes(storage.join(settings.out, "report.html"), page.encode())
    if settings.figures:
        # Imported here: matplotlib takes half a second, for figures alone.
        from pipeline.report.figures import write_figures

        write_figures(results, images, storage.join(settings.out, "figures"), settings.figures)


def _as_json(value: Any) -> Any:
    """A setting as JSON reads it back."""
    return list(value) if isinstance(value, tuple) else value


def _describe_rows(table: FeatureTable, split: Split) -> str:
    views = [str(view) for (own, view), count in table.counts.items() if own == split and count]
    return f"{split} rows of {' and '.join(sorted(views)) or 'no view'} in {table.path}"
