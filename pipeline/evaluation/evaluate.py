"""The evaluation stage: feature tables on disk -> metrics, per-query rows and the report in one
folder.

In: one table with query and gallery rows, or one table for each. Out: `queries.parquet`, `metrics.parquet`,
`report.html`, what pipeline/evaluation/extras.py writes, `evaluation.json` (what all of it was made from) and, last,
`metrics.json`: where that file is, the evaluation is complete.
"""

import time
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import pyarrow as pa

from pipeline.core import json_files, parquet, storage
from pipeline.core.errors import InputError
from pipeline.core.lock import locks_output
from pipeline.core.progress import console, progress
from pipeline.core.records import Split, View
from pipeline.evaluation.extras import ExtraOutputs, write_extras
from pipeline.evaluation.settings import EvaluationSettings
from pipeline.features.table import FeatureTable, Floats, open_table, verify_table
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
"Settings that change what is written besides the ranking."


@locks_output(lambda settings: settings.out)
def evaluate(settings: EvaluationSettings) -> list[dict[str, Any]]:
    """Evaluate into `settings.out` and return the metric rows. A finished evaluation of the same
    inputs is left as it is.

    Raises InputError when the tables do not go together or allow no task, or when the folder holds
    something else.
    """
    queries, gallery, tasks = plan_tasks(settings)
    ranked = {
        "fingerprint": queries.fingerprint, "queries": queries.digest, "gallery": gallery.digest,
        "protocol": settings.protocol, "tasks": [str(task) for task in tasks],
    }  # fmt: skip
    # Opened before the ranking, so that a wrong folder is refused before hours of work.
    shards = open_shards(settings.shards) if settings.shards else None
    if shards is not None and settings.verify:
        require_intact(shards)
    extras = read_report_context(settings.title, settings.run, settings.beside)
    shown = {name: _as_json(getattr(settings, name)) for name in OUTPUT_SETTINGS} | {
        "extras": extras.sha256
    }
    earlier = _read_earlier_inputs(settings.out)
    if earlier and earlier["ranked"] != ranked:
        different = ", ".join(
            name for name, value in ranked.items() if earlier["ranked"].get(name) != value
        )
        raise InputError(
            f"{settings.out} holds an evaluation of something else (different {different}); expected the same or an "
            "empty folder; choose another --out"
        )
    if earlier and not results_intact(settings.out, earlier):
        console.print(
            f"{settings.out}: a file is missing or damaged; evaluating again", style="yellow"
        )
        earlier = None
    if earlier and earlier["shown"] == shown:
        console.print(
            f"{settings.out} is complete: the same features were evaluated before; nothing to do"
        )
    elif earlier:
        # Until all is written anew it is of nothing that could be asked for, and says of no file
        # what is in it.
        results = read_evaluation(settings.out).results
        json_files.write_checksummed(
            storage.join(settings.out, INPUTS_FILE), {"ranked": ranked, "shown": {}}
        )
        _write_besides(settings, shards, queries, gallery, tasks, results)
        _write_report(settings, shards, queries, gallery, read_evaluation(settings.out), extras)
        write_inputs(settings.out, {"ranked": ranked, "shown": shown})
        console.print(
            f"{settings.out}: ranked before; wrote report.html and what goes with it anew"
        )
    else:
        inputs = {"ranked": ranked, "shown": shown}
        _evaluate(settings, shards, queries, gallery, tasks, inputs, extras)
    return read_result_rows(settings.out, METRICS_FILE)


def plan_tasks(settings: EvaluationSettings) -> tuple[FeatureTable, FeatureTable, list[Task]]:
    """The two tables and the tasks they are to be evaluated on.

    Raises InputError when they come from different networks, allow no task, or more than the one
    that was asked for.
    """
    opened = verify_table if settings.verify else open_table
    queries = opened(settings.table or settings.queries or "")
    gallery = queries if settings.table else opened(settings.gallery or "")
    if queries.fingerprint != gallery.fingerprint:
        raise InputError(
            f"queries were embedded by network {queries.fingerprint[:12]} and the gallery by {gallery.fingerprint[:12]}; "
            "expected one; embed both with the same checkpoint (jobs/embed_gallery.py --checkpoint)"
        )
    possible = [
        task
        for task in possible_tasks(queries, gallery)
        if settings.query_view in (None, str(task.query_view))
        and settings.gallery_view in (None, str(task.gallery_view))
    ]
    if not possible:
        raise InputError(
            f"found {_describe_rows(queries, Split.QUERY)} and {_describe_rows(gallery, Split.GALLERY)}; expected query rows of one view and "
            "gallery rows of another; embed both splits, or name other views with --query-view and --gallery-view"
        )
    if settings.table:
        both = Task(query_view=View.DRONE, gallery_view=View.SATELLITE)
        merged = [replace(task, multi_query=True) for task in possible if task == both]
        return queries, gallery, possible + merged
    if len(possible) > 1:
        raise InputError(
            f"the tables allow {', '.join(task.name for task in possible)}; expected one task; choose with --query-view and "
            "--gallery-view, or give one --table for all of them"
        )
    return queries, gallery, [replace(possible[0], multi_query=settings.multi_query)]


def _evaluate(
    settings: EvaluationSettings, shards: ShardSet | None, queries: FeatureTable,
    gallery: FeatureTable, tasks: list[Task], inputs: dict[str, Any], extras: ReportContext,
) -> None:  # fmt: skip
    begin = time.monotonic()
    if storage.exists(storage.join(settings.out, INPUTS_FILE)):
        storage.remove(storage.join(settings.out, INPUTS_FILE))  # of a run that was not finished
    found, spent = [], {}
    for task in tasks:
        started = time.monotonic()
        known = settings.protocol == "full" and not task.multi_query
        pairs = (
            queries.counts[Split.QUERY, task.query_view]
            * gallery.counts[Split.GALLERY, task.gallery_view]
        )
        with progress(pairs if known else None, str(task), "scores") as meter:
            found.append(
                retrieve(
                    task, queries, gallery, settings.protocol, None, meter.advance, settings.workers
                )
            )
        spent[str(task)] = time.monotonic() - started
    rows, results = (
        [each.metrics for each in found],
        pa.concat_tables([each.queries for each in found]),
    )
    for name, table in (
        (RESULTS_FILE, results),
        ("metrics.parquet", pa.Table.from_pylist(rows, METRICS_SCHEMA)),
    ):
        parquet.write_table(storage.join(settings.out, name), table)
    started = time.monotonic()
    _write_besides(settings, shards, queries, gallery, tasks, results)
    spent["views, groups and exports"] = time.monotonic() - started
    started = time.monotonic()
    findings = EvaluationResults(
        name=settings.title, metrics=rows, results=results, **read_extras(settings.out)
    )
    _write_report(settings, shards, queries, gallery, findings, extras)
    spent["report"] = time.monotonic() - started
    metrics = storage.encode_json(rows)
    write_inputs(settings.out, inputs, metrics)
    storage.write_bytes(storage.join(settings.out, METRICS_FILE), metrics)
    parts = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in spent.items())
    console.print(
        f"{storage.join(settings.out, METRICS_FILE)}: {time.monotonic() - begin:.1f} s ({parts})"
    )


def _write_besides(
    settings: EvaluationSettings,
    shards: ShardSet | None,
    queries: FeatureTable,
    gallery: FeatureTable,
    tasks: list[Task],
    results: pa.Table,
) -> None:
    write_extras(
        ExtraOutputs(
            out=settings.out,
            protocol=settings.protocol,
            workers=settings.workers,
            views=settings.views,
            parts=settings.parts,
            by=settings.by,
            exports=settings.exports,
            shards=shards,
            answer_order=settings.answer_order,
        ),
        queries,
        gallery,
        tasks,
        results,
    )


def _write_report(
    settings: EvaluationSettings,
    shards: ShardSet | None,
    queries: FeatureTable,
    gallery: FeatureTable,
    findings: EvaluationResults,
    extras: ReportContext,
) -> None:
    def vectors(keys: Iterable[str]) -> dict[str, Floats]:
        wanted = set(keys)
        sides = (
            embedding_set_from_table(queries.select(Split.QUERY)),
            embedding_set_from_table(gallery.select(Split.GALLERY)),
        )
        return {
            key: vector_D
            for side in sides
            for key, vector_D in vectors_by_key(side, wanted).items()
        }

    pictures = no_images if shards is None else shards.fetch
    page = render_report(findings, extras, pictures, vectors, settings.panels)
    storage.write_bytes(storage.join(settings.out, "report.html"), page.encode())
    if settings.figures:
        from pipeline.report.figures import (
            write_figures,
        )  # here: matplotlib takes half a second, for this alone

        write_figures(findings, pictures, storage.join(settings.out, "figures"), settings.figures)


def _as_json(value: Any) -> Any:
    """A setting as JSON gives it back."""
    return list(value) if isinstance(value, tuple) else value


def _read_earlier_inputs(out: str) -> dict[str, Any] | None:
    if not storage.exists(storage.join(out, METRICS_FILE)):
        return None
    said = read_inputs(out)
    if said is None:
        raise InputError(
            f"{out} holds a {METRICS_FILE} without {INPUTS_FILE}; expected an evaluation's folder; choose another --out or delete {out}"
        )
    return said


def _describe_rows(table: FeatureTable, split: Split) -> str:
    views = [str(view) for (held, view), count in table.counts.items() if held == split and count]
    return f"{split} rows of {' and '.join(sorted(views)) or 'no view'} in {table.path}"
