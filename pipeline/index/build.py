"""The indexing stage: feature table -> index on disk, within a memory budget, with measured recall.

In: a feature table, or one split or view of it. Out: a folder of the trained index, the parts with
their ids, and `index.json`, written last. The finished work units of a killed build lie in
`_building` until then, and the same command resumes with them.
"""

import json
import math
import os
import time
from dataclasses import asdict
from typing import Any

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.json_files import from_json
from pipeline.core.lock import locks_output
from pipeline.core.progress import console, results
from pipeline.core.records import Split
from pipeline.features.table import FeatureTable, open_table, verify_table
from pipeline.index.faiss_io import FAISS
from pipeline.index.finish import finish_index, load_finished
from pipeline.index.metadata import METADATA_FILE, IndexMetadata, SearchParams
from pipeline.index.planning.choice import plan_label
from pipeline.index.planning.plan import IndexPlan
from pipeline.index.planning.planner import Decision, Planner, print_decision
from pipeline.index.settings import IndexSettings
from pipeline.index.train import new_index, sample_rows, train_index
from pipeline.index.tuning.ground_truth import sample_queries
from pipeline.index.workspace import BuildWorkspace, rows_by_part, unfinished_work

DECIDING = ("split", "view", "factory", "refine", "parts")
"Names of the settings that decide which rows an index holds and how."


@locks_output(lambda settings: settings.out)
def build_index(settings: IndexSettings) -> IndexMetadata:
    """Build the index of a table, or of one split or view of it; a finished one is not touched.
    Returns its metadata.

    Raises InputError on unusable input, and where no index fits the budget.
    """
    table = verify_table(settings.table) if settings.verify else open_table(settings.table)
    selected = table.select(settings.split, settings.view)
    given = _given(settings)
    if storage.exists(storage.join(settings.out, METADATA_FILE)):
        finished = load_finished(settings.out, selected, given, settings.verify)
        if finished is not None:
            return finished
    rows_of_part = _checked_rows(settings, selected, table)
    FAISS.omp_set_num_threads(os.cpu_count() or 1)  # Ray sets OMP_NUM_THREADS in its jobs
    planner = Planner(settings, selected, rows_of_part)
    request = _as_json(
        {"settings": given, "table": table.digest, "gallery": asdict(planner.gallery)}
    )
    decision = _unfinished_decision(settings.out, request) or planner.decide({})
    while decision is not None:
        print_decision(decision, planner.gallery.rows, console)
        identity = request | {"decision": _as_json(asdict(decision))}
        workspace = BuildWorkspace(settings.out, selected, identity, settings.workers)
        others = table.select(Split.QUERY) if settings.split == Split.GALLERY else None
        metadata = _build_plan(settings, (selected, others), rows_of_part, decision, workspace)
        reached = metadata.measured["recall_at_10"]
        if settings.factory or reached >= settings.target_recall:
            break
        why = f"recall@10 {reached:.3f} once built, below {settings.target_recall}"
        decision = planner.decide(decision.failed | {plan_label(decision.plan): why})
        if decision is None or not decision.promised:
            break
        console.print(f"{why}; the next plan is built", style="yellow")
        storage.remove(storage.join(settings.out, METADATA_FILE))
    return metadata


def plan_only(settings: IndexSettings) -> Decision:
    """What `build_index` would build, with the Pareto front of all plans; nothing is written.

    Raises InputError as `build_index` does.
    """
    table = open_table(settings.table)
    selected = table.select(settings.split, settings.view)
    FAISS.omp_set_num_threads(os.cpu_count() or 1)  # Ray sets OMP_NUM_THREADS in its jobs
    planner = Planner(settings, selected, _checked_rows(settings, selected, table))
    decision = planner.decide({})
    assert decision is not None, "a gallery has a plan"
    print_decision(decision, planner.gallery.rows, results)
    return decision


def _given(settings: IndexSettings) -> dict[str, Any]:
    """The settings that decide which rows an index holds and how."""
    return {name: getattr(settings, name) for name in DECIDING}


def _as_json(value: dict[str, Any]) -> dict[str, Any]:
    """The object as a file gives it back."""
    read_back: dict[str, Any] = json.loads(json.dumps(value))
    return read_back


def _checked_rows(
    settings: IndexSettings, selected: FeatureTable, table: FeatureTable
) -> dict[str, int]:
    """The selected rows by the table's parts. Raises InputError where there are none."""
    rows_of_part = rows_by_part(selected)
    if not rows_of_part:
        kinds = ", ".join(
            f"{count} {split} {view}" for (split, view), count in table.counts.items()
        )
        raise InputError(
            f"{settings.table} holds {kinds} and none of it was asked for; check --split and --view"
        )
    return rows_of_part


def _unfinished_decision(out: str, request: dict[str, Any]) -> Decision | None:
    """The decision of an unfinished build of the same request, which is not tried again."""
    work = unfinished_work(out) or {}
    found = work.pop("decision", None)
    try:
        return from_json(Decision, found) if work == request else None
    except ValueError:
        return None


def _build_plan(
    settings: IndexSettings,
    tables: tuple[FeatureTable, FeatureTable | None],
    rows_of_part: dict[str, int],
    decision: Decision,
    workspace: BuildWorkspace,
) -> IndexMetadata:
    """Train, build, merge and measure one plan; returns the metadata that it wrote. `tables`: the
    rows to index, and those to query with.
    """
    start, plan = time.perf_counter(), decision.plan
    selected, others = tables
    index = new_index(plan.factory, selected.dimension)
    training_rows = 0 if index.is_trained else plan.training_rows
    measured: dict[str, Any] = {"rejected": decision.rejected}
    if not workspace.is_trained():
        if training_rows:
            _train(index, plan, selected, rows_of_part)
            measured["training_seconds"] = round(time.perf_counter() - start, 3)
        workspace.save_trained(index)
    rows = sum(rows_of_part.values())
    part_rows = min(plan.part_rows, math.ceil(rows / settings.parts))
    if decision.front:
        measured |= {"pareto_front": list(decision.front), "trial_rows": decision.sample_rows}
    if settings.p99_ms is not None:
        measured |= {"p99_limit_ms": settings.p99_ms, "latency_batch": settings.batch}
    metadata = IndexMetadata(
        factory=plan.factory,
        metric="inner product",
        rows=rows,
        dimension=selected.dimension,
        fingerprint=selected.fingerprint,
        encoding=selected.encoding,
        table=storage.absolute(selected.path),
        settings=_given(settings),
        reason=plan.reason,
        refine=plan.refine,
        on_disk=plan.on_disk,
        search_params=SearchParams(nprobe_or_ef=1),
        target_recall=settings.target_recall,
        training_sample=training_rows,
        build_seconds=0.0,
        bytes_per_vector=0.0,
        expected_bytes=plan.bytes or None,
        unit_rows=plan.unit_rows,
        part_rows=part_rows,
        measured=measured,
        parts=workspace.build(rows_of_part, plan.unit_rows, part_rows),
        trained=workspace.publish_trained(),
    )
    queries = sample_queries(selected, rows_of_part, others)
    return finish_index(settings.out, metadata, queries, workspace, start)


def _train(index: Any, plan: IndexPlan, table: FeatureTable, rows_of_part: dict[str, int]) -> None:
    """Train a plan's empty index. The sample is gone when rows are added."""
    _, sample_SD = sample_rows(table, rows_of_part, plan.training_rows)
    train_index(index, plan.factory, sample_SD)
