"""The indexing stage: feature table -> index on disk, within a memory budget, with measured recall.

In: a feature table, or one split or view of it. Out: a folder of the trained index, the parts with
their ids, and `index.json`, written last. The finished work units of a killed build lie in
`_building` until then, and the same command resumes with them.
"""

import math
import os
import time
from dataclasses import asdict, replace

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.lock import locks_output
from pipeline.core.progress import console
from pipeline.core.records import Split
from pipeline.features.row_reader import supports_row_reads
from pipeline.features.table import FeatureTable, open_table, verify_table
from pipeline.index.faiss_io import FAISS
from pipeline.index.finish import finish_index, load_finished
from pipeline.index.metadata import METADATA_FILE, IndexMetadata, SearchParams
from pipeline.index.plan import GallerySpec, IndexPlan, plan_factory, plan_index
from pipeline.index.recall import sample_queries
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
def build_index(settings: IndexSettings) -> IndexMetadata:
    """Build the index of a table, or of one split or view of it; a finished one is not touched.
    Returns its metadata.

    Raises InputError on unusable input, and where no index fits the budget.
    """
    table = verify_table(settings.table) if settings.verify else open_table(settings.table)
    selected = table.select(settings.split, settings.view)
    given = {
        name: getattr(settings, name) for name in ("split", "view", "factory", "refine", "parts")
    }
    if storage.exists(storage.join(settings.out, METADATA_FILE)):
        finished = load_finished(settings.out, selected, given, settings.verify)
        if finished is not None:
            return finished
    rows_of_part = rows_by_part(selected)
    if not rows_of_part:
        kinds = ", ".join(
            f"{count} {split} {view}" for (split, view), count in table.counts.items()
        )
        raise InputError(
            f"{settings.table} holds {kinds} and none of it was asked for; check --split and --view"
        )
    FAISS.omp_set_num_threads(os.cpu_count() or 1)  # Ray sets OMP_NUM_THREADS in its jobs
    start = time.perf_counter()
    plan = make_plan(settings, selected, rows_of_part)
    memory = f"; {plan.bytes / 1e9:.2f} GB of memory" if plan.bytes else ""
    console.print(f"{plan.factory}: {plan.reason}{memory}")
    identity = {"settings": given, "table": table.digest, "plan": asdict(plan)}
    workspace = BuildWorkspace(settings.out, selected, identity, settings.workers)
    index = new_index(plan.factory, table.dimension)
    training_rows = 0 if index.is_trained else plan.training_rows
    if not workspace.is_trained():
        if training_rows:
            _, sample_SD = sample_rows(selected, rows_of_part, training_rows)
            train_index(index, plan.factory, sample_SD)
        workspace.save_trained(index)
    rows = sum(rows_of_part.values())
    part_rows = min(plan.part_rows, math.ceil(rows / settings.parts))
    metadata = IndexMetadata(
        factory=plan.factory,
        metric="inner product",
        rows=rows,
        dimension=table.dimension,
        fingerprint=table.fingerprint,
        encoding=table.encoding,
        table=storage.absolute(table.path),
        settings=given,
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
        measured={},
        parts=workspace.build(rows_of_part, plan.unit_rows, part_rows),
        trained=workspace.publish_trained(),
    )
    others = table.select(Split.QUERY) if settings.split == Split.GALLERY else None
    queries = sample_queries(selected, rows_of_part, others)
    return finish_index(settings.out, metadata, queries, workspace, start)


def make_plan(
    settings: IndexSettings, table: FeatureTable, rows_of_part: dict[str, int]
) -> IndexPlan:
    """The planner's choice for a table, or the factory that the user gave."""
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
    _, sample_SD = sample_rows(table, rows_of_part, min(SPECTRUM_ROWS, plan.training_rows))
    return plan_index(replace(gallery, effective_dimension=effective_dimension(sample_SD)))
