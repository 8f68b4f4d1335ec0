"""The indexing stage: feature table -> index on disk, within a memory budget, with the recall that
was measured.

In: a feature table, or one split or view of it. Out: a folder of the trained index, the parts with
their ids, and `index.json`, written last. What a killed build has done lies in `_building` until
then: the same command goes on with it.
"""

import math
import os
import time
from dataclasses import asdict, replace
from typing import Any

import faiss

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.lock import locks_output
from pipeline.core.progress import console
from pipeline.core.records import Split
from pipeline.features.row_reader import supports_row_reads
from pipeline.features.table import FeatureTable, open_table, verify_table
from pipeline.index.metadata import (
    METADATA_FILE,
    IndexMetadata,
    SearchParams,
    check_files,
    metadata_dict,
    read_metadata,
    write_metadata,
)
from pipeline.index.plan import GallerySpec, IndexPlan, plan_factory, plan_index
from pipeline.index.recall import (
    RecallQueries,
    measure_speed,
    sample_queries,
    search_param_grid,
    tune,
)
from pipeline.index.searcher import Index
from pipeline.index.settings import IndexSettings, parse_bytes
from pipeline.index.train import (
    SPECTRUM_ROWS,
    effective_dimension,
    new_index,
    sample_rows,
    train_index,
)
from pipeline.index.workspace import BuildWorkspace, rows_by_part


@locks_output(lambda settings: settings.out)
def build_index(settings: IndexSettings) -> dict[str, Any]:
    """Build the index of a table, or of one split or view of it; a finished one is left as it is.
    Returns its facts.

    Raises InputError on unusable input, and where no index fits the budget.
    """
    table = verify_table(settings.table) if settings.verify else open_table(settings.table)
    chosen = table.select(settings.split, settings.view)
    asked = {
        name: getattr(settings, name) for name in ("split", "view", "factory", "refine", "parts")
    }
    if storage.exists(storage.join(settings.out, METADATA_FILE)):
        told = _load_finished(settings.out, chosen, asked, settings.verify)
        if told is not None:
            return metadata_dict(told)
    rows_of_part = rows_by_part(chosen)
    if not rows_of_part:
        held = ", ".join(f"{count} {split} {view}" for (split, view), count in table.counts.items())
        raise InputError(
            f"{settings.table} holds {held} and none of it was asked for; check --split and --view"
        )
    faiss.omp_set_num_threads(
        os.cpu_count() or 1
    )  # Ray sets OMP_NUM_THREADS in its jobs; this one uses all cores
    start = time.perf_counter()
    plan = make_plan(settings, chosen, rows_of_part)
    console.print(
        f"{plan.factory}: {plan.why}"
        + (f"; {plan.bytes / 1e9:.2f} GB of memory" if plan.bytes else "")
    )
    workshop = BuildWorkspace(
        out=settings.out, table=chosen, workers=settings.workers,
        identity={"asked": asked, "table": table.digest, "plan": asdict(plan)},
    )  # fmt: skip
    index = new_index(plan.factory, table.dimension)
    training_rows = 0 if index.is_trained else plan.training_rows
    if not workshop.is_trained():
        if training_rows:
            train_index(index, plan.factory, sample_rows(chosen, rows_of_part, training_rows)[1])
        workshop.save_trained(index)
    rows = sum(rows_of_part.values())
    part_rows = min(plan.part_rows, math.ceil(rows / settings.parts))
    parts = workshop.build(rows_of_part, plan.unit_rows, part_rows)
    facts = IndexMetadata(
        factory=plan.factory,
        metric="inner product",
        rows=rows,
        dimension=table.dimension,
        fingerprint=table.fingerprint,
        table=storage.absolute(table.path),
        asked=asked,
        why=plan.why,
        refine=plan.refine,
        on_disk=plan.on_disk,
        effort=SearchParams(breadth=1),
        target_recall=settings.target_recall,
        training_sample=training_rows,
        build_seconds=0.0,
        bytes_per_vector=0.0,
        expected_bytes=plan.bytes or None,
        unit_rows=plan.unit_rows,
        part_rows=part_rows,
        measured={},
        parts=parts,
        trained=workshop.publish_trained(),
    )
    others = table.select(Split.QUERY) if settings.split == Split.GALLERY else None
    return finish_index(
        settings.out, facts, sample_queries(chosen, rows_of_part, others), workshop, start
    )


def make_plan(
    settings: IndexSettings, table: FeatureTable, rows_of_part: dict[str, int]
) -> IndexPlan:
    """The planner's answer for a table, or what the user asked for."""
    gallery = GallerySpec(
        rows=sum(rows_of_part.values()),
        dimension=table.dimension,
        budget=parse_bytes(settings.memory_budget),
        target_recall=settings.target_recall,
        rows_readable=supports_row_reads(table.path),
        workers=settings.workers,
    )
    if settings.factory:
        return plan_factory(gallery, settings.factory, "table" if settings.refine else "none")
    plan = plan_index(gallery)
    if not plan.training_rows:
        return plan
    directions = effective_dimension(
        sample_rows(table, rows_of_part, min(SPECTRUM_ROWS, plan.training_rows))[1]
    )
    return plan_index(replace(gallery, effective_dimension=directions))


def finish_index(
    out: str, facts: IndexMetadata, held: RecallQueries, workshop: BuildWorkspace, start: float
) -> dict[str, Any]:
    """Find the effort that reaches the recall, write what the index is, and clear the workshop.
    Returns its facts.
    """
    size = sum(
        each["bytes"]
        for part in facts.parts
        for name, each in part.files.items()
        if name.endswith(".faiss")
    )
    built = round(time.perf_counter() - start, 3)
    whole = replace(facts, parts=tuple(replace(part, removed=()) for part in facts.parts))
    index = Index(
        out, told=whole
    )  # measured as if nothing had been removed: exact search knows of no removals
    effort, at_1, at_10 = tune(
        index,
        held,
        search_param_grid(new_index(facts.factory, facts.dimension), facts.refine),
        facts.target_recall,
    )
    measured = {
        "recall_at_1": at_1,
        "recall_at_10": at_10,
        "recall_queries": len(held.queries_QD),
        "recall_queries_from": held.source,
    }
    measured |= measure_speed(index, held, effort)
    facts = replace(
        facts,
        effort=effort,
        build_seconds=built,
        bytes_per_vector=size / facts.rows,
        measured=measured,
    )
    write_metadata(out, facts)
    workshop.clear()
    if at_10 < facts.target_recall:
        console.print(
            f"recall@10 is {at_10:.3f} however hard the search tries, below the target of {facts.target_recall}; the index is "
            "kept; a larger --memory-budget or another --factory may reach it",
            style="yellow",
        )
    console.print(
        f"{out}: {facts.rows} rows, {facts.factory}, recall@10 {at_10:.3f} of exact, "
        f"{measured['queries_per_second']:.0f} queries/s"
    )
    return metadata_dict(facts)


def _load_finished(
    out: str, table: FeatureTable, asked: dict[str, Any], whole: bool
) -> IndexMetadata | None:
    """A finished index of the same rows and settings; None where it was one, is damaged, and is to
    be built again.

    `whole`: every byte is looked at. Raises InputError where it is another's.
    """
    told = read_metadata(out)
    held = told.table_parts
    missing = rows_by_part(table.only([name for name in table.parts if name not in held]))
    if (
        told.asked == asked
        and told.fingerprint == table.fingerprint
        and held.items() <= table.shards.items()
    ):
        if missing:
            raise InputError(
                f"{out} holds an index of {len(held)} parts of the table, which has {len(missing)} more by now; say --extend "
                "to add them, or choose another --out"
            )
        if _files_intact(out, told, whole):
            console.print(f"{out} is complete: {told.rows} rows, {told.factory}; nothing to do")
            return told
        storage.remove(storage.join(out, METADATA_FILE))
        return None
    raise InputError(
        f"{out} holds an index of other rows or settings; choose another --out or delete it"
    )


def _files_intact(out: str, told: IndexMetadata, whole: bool) -> bool:
    """Whether each file of an index is there and has its size, or is what was written.

    Raises InputError where not, and building again would not give the same index.
    """
    try:
        for files in told.files:
            check_files(out, files, whole)
    except InputError as error:
        if removed := sum(len(part.removed) for part in told.parts):
            raise InputError(f"{error}, and remove the {removed} locations again") from None
        console.print(
            f"{out}: a file is missing or not what was written; the index is built again",
            style="yellow",
        )
        return False
    return True
