"""The settings of an evaluation: flags of jobs/evaluate.py. Imports nothing heavy, so that the
command line is parsed at once."""

from dataclasses import dataclass
from typing import Literal

from pipeline.core.errors import InputError, require
from pipeline.report.options import DEFAULT_PANELS, FigureFormat
from pipeline.retrieval.metrics import Protocol

ViewName = Literal["drone", "satellite", "street", "google"]
ExportFormat = Literal["answer", "mat"]


@dataclass(frozen=True, kw_only=True)
class EvaluationSettings:
    """What to evaluate: --table for every task that it allows, or --queries and --gallery for
    one."""

    out: str
    "Folder for the results; a path or a URI."
    table: str | None = None
    """Feature table with query and gallery rows: every task of two views, and multi-query
    drone->satellite."""
    queries: str | None = None
    "Feature table that holds the query rows."
    gallery: str | None = None
    "Feature table that holds the gallery rows."
    protocol: Protocol = "full"
    """full: the official one, with all distractors. queried-only: gallery rows of queried locations
    alone."""
    multi_query: bool = False
    "One query per location, the mean of its queries' features; with --queries and --gallery."
    query_view: ViewName | None = None
    "View of the queries; needed if the tables allow more than one task."
    gallery_view: ViewName | None = None
    "View of the gallery."
    shards: str | None = None
    "Folder of the shards that were embedded: their pictures are shown in the report."
    run: str | None = None
    "Folder of the training run: its curves are shown in the report."
    beside: str | None = None
    """Folder of another evaluation on the same images, shown beside this one, such as the untrained
    network's."""
    title: str = "Retrieval evaluation"
    "Headline of the report."
    panels: int = DEFAULT_PANELS
    """Hits, and as many misses, that the report shows of each task; a few are open, the others
    unfold on a click."""
    workers: int = 0
    """Ray tasks that rank, of one core each, each for some of the queries; 0: this process ranks,
    on all cores."""
    verify: bool = False
    "Verify every byte of the tables first, and of the shards if they are given."
    views: bool = True
    "Measure drone->satellite by the number of views that a query is the mean of."
    parts: bool = True
    """Measure each part of the embedding alone, and all others without it: for four parts, the time
    of four rankings."""
    by: tuple[str, ...] = ()
    """Columns of the shards' records to break the measures down by, such as altitude_m or
    heading_deg; with --shards."""
    exports: tuple[ExportFormat, ...] = ()
    "answer: the challenge's answer.txt. mat: the features as pytorch_result.mat."
    figures: tuple[FigureFormat, ...] = ()
    "Formats, png or pdf, in which to write figures for a paper, into the folder figures/."
    answer_order: str | None = None
    """Text file with the queries' file names in the challenge's order, one a line; with --exports
    answer and --shards."""

    def __post_init__(self) -> None:
        one, two = self.table is not None, (self.queries is not None, self.gallery is not None)
        if one == any(two) or (any(two) and not all(two)):
            given = [
                f"--{name}"
                for name in ("table", "queries", "gallery")
                if getattr(self, name) is not None
            ]
            raise InputError(
                f"found {' and '.join(given) or 'no table'}; "
                "expected --table alone, or --queries and --gallery together"
            )
        if one and self.multi_query:
            raise InputError(
                "found --multi-query with --table, which evaluates it already; leave it out"
            )
        if self.by and not self.shards:
            raise InputError(
                f"found --by {' '.join(self.by)} without --shards, whose records have the column; "
                "add --shards"
            )
        if self.answer_order and ("answer" not in self.exports or not self.shards or self.table):
            raise InputError(
                "found --answer-order, expected one task (--queries and --gallery), "
                "--exports answer and --shards with it; add them"
            )
        panels, workers = self.panels, self.workers
        require(panels >= 0, "panels", panels, f"0 or more; leave it out for {DEFAULT_PANELS}")
        require(workers >= 0, "workers", workers, "0 or more; leave it out to rank in this process")
