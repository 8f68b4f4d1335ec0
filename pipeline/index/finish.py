"""The end of a build: recall and speed measured, `index.json` written; and the check of a finished
index when the build is run again.
"""

import time
from dataclasses import replace
from functools import partial
from typing import Any

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.progress import console
from pipeline.features.table import FeatureTable
from pipeline.index.metadata import (
    METADATA_FILE,
    IndexMetadata,
    SearchParams,
    check_files,
    read_metadata,
    write_metadata,
)
from pipeline.index.searcher import Index
from pipeline.index.train import new_index
from pipeline.index.tuning.ground_truth import NEIGHBOURS, RecallQueries
from pipeline.index.tuning.recall import TIMED_SECONDS, measure_speed
from pipeline.index.tuning.search_params import search_param_grid, tune, tune_hidden
from pipeline.index.workspace import BuildWorkspace, rows_by_part


def finish_index(
    out: str,
    metadata: IndexMetadata,
    queries: RecallQueries,
    workspace: BuildWorkspace,
    start: float,
) -> IndexMetadata:
    """Find the search parameters that reach the recall, write the metadata, and clear the
    workspace. Returns the metadata with the measured figures.
    """
    sizes = [
        file.bytes
        for part in metadata.parts
        for name, file in part.files.items()
        if name.endswith(".faiss")
    ]
    build_seconds = round(time.perf_counter() - start, 3)
    # Measured as if nothing had been removed, for exact search returns removed locations.
    all_parts = tuple(replace(part, removed=()) for part in metadata.parts)
    index = Index(out, metadata=replace(metadata, parts=all_parts))
    grid = [*search_param_grid(new_index(metadata.factory, metadata.dimension), metadata.refine)]
    limit, batch = metadata.measured.get("p99_limit_ms"), metadata.measured.get("latency_batch", 1)

    def speed(params: SearchParams, batch: int) -> dict[str, float]:
        search = partial(index.search, k=NEIGHBOURS, params=params)  # the ids included
        return measure_speed(search, queries.queries_QD, batch, TIMED_SECONDS)

    def fast_enough(params: SearchParams) -> bool:
        return limit is None or speed(params, batch)["p99_ms"] <= limit

    params, at_1, at_10 = tune(index, queries, grid, metadata.target_recall, fast_enough)
    params, filtered_at_10 = tune_hidden(
        index, queries, params, metadata.target_recall, max(step.nprobe_or_ef for step in grid)
    )
    single = speed(params, 1)
    measured = metadata.measured | {
        "recall_at_1": at_1,
        "recall_at_10": at_10,
        "filtered_recall_at_10": filtered_at_10,
        "recall_queries": len(queries.queries_QD),
        "recall_queries_from": queries.source,
        "milliseconds_per_query": single["p50_ms"],
        **single,
    }
    if limit is not None:
        measured["batch_p99_ms"] = speed(params, batch)["p99_ms"]
    metadata = replace(
        metadata,
        search_params=params,
        build_seconds=build_seconds,
        bytes_per_vector=sum(sizes) / metadata.rows,
        measured=measured,
    )
    write_metadata(out, metadata)
    workspace.clear()
    if at_10 < metadata.target_recall:
        within = "" if limit is None else f" within {limit} ms"
        console.print(
            f"recall@10 is {at_10:.3f} with the most thorough search{within}, below the target of "
            f"{metadata.target_recall}; the index is kept; a larger --memory-budget or another "
            "--factory may reach it",
            style="yellow",
        )
    if limit is not None and measured["batch_p99_ms"] > limit:
        console.print(
            f"p99 of batches of {batch} is {measured['batch_p99_ms']} ms, above the {limit} given; "
            "the index is kept; its searches are the fastest that it has, or the machine was busy",
            style="yellow",
        )
    console.print(
        f"{out}: {metadata.rows} rows, {metadata.factory}, recall@10 {at_10:.3f} of exact, "
        f"{filtered_at_10:.3f} with a filter that hides a query's place, "
        f"{measured['queries_per_second']:.0f} queries/s in batches of "
        f"{len(queries.queries_QD)}, single ones p50 {single['p50_ms']} ms, p99 "
        f"{single['p99_ms']} ms"
    )
    return metadata


def load_finished(
    out: str, table: FeatureTable, settings: dict[str, Any], verify: bool
) -> IndexMetadata | None:
    """The finished index of the same rows and settings; None where it is damaged and must be built
    again.

    `verify`: compare every byte with its checksum. Raises InputError where it is an index of other
    rows or settings.
    """
    metadata = read_metadata(out)
    indexed = metadata.table_parts
    if not (
        metadata.settings == settings
        and metadata.fingerprint == table.fingerprint
        and indexed.items() <= table.shards.items()
    ):
        raise InputError(
            f"{out} holds an index of other rows or settings; choose another --out or delete it"
        )
    if added := rows_by_part(
        table.with_parts([name for name in table.parts if name not in indexed])
    ):
        raise InputError(
            f"{out} holds an index of {len(indexed)} parts of the table, which has {len(added)} "
            "more by now; say --extend to add them, or choose another --out"
        )
    if _files_intact(out, metadata, verify):
        console.print(f"{out} is complete: {metadata.rows} rows, {metadata.factory}; nothing to do")
        return metadata
    storage.remove(storage.join(out, METADATA_FILE))
    return None


def _files_intact(out: str, metadata: IndexMetadata, verify: bool) -> bool:
    """Whether each file of an index is there and has its size, with `verify` its hash too.

    Raises InputError where not, and building again would not give the same index.
    """
    try:
        for files in metadata.files:
            check_files(out, files, content=verify)
    except InputError as error:
        if removed := sum(len(part.removed) for part in metadata.parts):
            raise InputError(f"{error}, and remove the {removed} locations again") from None
        console.print(
            f"{out}: a file is missing or damaged; the index is built again", style="yellow"
        )
        return False
    return True
