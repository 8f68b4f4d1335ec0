"""The settings of building an index: flags of jobs/build_index.py.

Imports nothing heavy, so that the command line is parsed at once.
"""

import re
from dataclasses import dataclass

from pipeline.core.errors import InputError, require
from pipeline.core.records import Split, View

BYTE_UNITS = {"": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}


@dataclass(frozen=True, kw_only=True)
class IndexSettings:
    """Which table is indexed, and how."""

    table: str
    "Folder or URI of the feature table."
    out: str
    "Folder or URI of the index."
    split: Split | None = None
    "Only rows of this split."
    view: View | None = None
    "Only rows of this view."
    memory_budget: str = "4GB"
    """Memory that building and searching may take, the process included: a number with KB, MB, GB
    or TB."""
    target_recall: float = 0.95
    "Recall@10 against exact search that the index is to reach."
    p99_ms: float | None = None
    """Milliseconds within which 99 of 100 batches of --batch queries are to be answered, at the
    cost of recall where no index has both."""
    batch: int = 1
    "Queries that are asked at once, for --p99-ms."
    build_minutes: float | None = None
    "Minutes that building may take; by default any."
    selectivity: float = 1.0
    "Share of the rows that the filters of searches leave, where all searches have one."
    dry_run: bool = False
    """Try the plans on a sample and print what each is expected to reach and take; build
    nothing."""
    factory: str | None = None
    "FAISS factory string; by default the planner chooses."
    refine: bool = False
    "With --factory: score the best candidates again by the table's own vectors."
    parts: int = 1
    "Parts of the index, each a file that a machine of a cluster can hold."
    workers: int = 0
    """Ray tasks that build units of the index, of one core each; 0: this process builds, on all
    cores."""
    verify: bool = False
    """Compare every byte of the table with its checksums first, and every byte of an index that is
    finished."""

    def __post_init__(self) -> None:
        recall = self.target_recall
        require(0 < recall <= 1, "target_recall", recall, "a fraction above 0 and at most 1")
        share = self.selectivity
        require(0 < share <= 1, "selectivity", share, "a fraction above 0 and at most 1")
        for name in ("p99_ms", "build_minutes"):
            given = getattr(self, name)
            require(given is None or given > 0, name, given, "a number above 0")
        require(self.batch >= 1, "batch", self.batch, "at least 1")
        require(self.parts >= 1, "parts", self.parts, "at least 1")
        require(self.workers >= 0, "workers", self.workers, "0 or more")
        if self.refine and not self.factory:
            raise InputError(
                "found --refine without --factory, where the planner decides it; leave it out or "
                "name a --factory"
            )
        parse_bytes(self.memory_budget)


def parse_bytes(text: str) -> int:
    """The number of bytes that a text such as `4GB` stands for.

    Raises InputError.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([KMGT]?)B?\s*", text.upper())
    if match is None:
        raise InputError(
            f"--memory-budget is {text!r}, expected a number with KB, MB, GB or TB, such as 4GB"
        )
    return int(float(match[1]) * BYTE_UNITS[match[2] and f"{match[2]}B"])
