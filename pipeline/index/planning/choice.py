"""Chooses among plans that were tried: the trials and the limits in, one plan with the settings of
its search out, the Pareto front, and why each other plan was rejected. Pure functions.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.core.errors import InputError
from pipeline.index.planning.plan import GallerySpec, IndexPlan


@dataclass(frozen=True, kw_only=True)
class TrialPoint:
    """One setting of a plan's search, tried on a sample and extrapolated to all rows."""

    nprobe_or_ef: int
    rerank_factor: int
    list_ratio: float = 0.0
    recall: float
    "Recall@10 as expected at all rows."
    sample_recall: float
    "Recall@10 as measured on the sample."
    queries_per_second: float
    "In one batch, as expected at all rows."
    p99_ms: float
    "Milliseconds within which 99 of 100 batches were answered, as expected at all rows."


@dataclass(frozen=True, kw_only=True)
class PlanTrial:
    """A plan, tried on a sample of the gallery's vectors."""

    plan: IndexPlan
    points: tuple[TrialPoint, ...]
    "From the fastest search to the most thorough."
    bytes_per_row: float
    "Of the FAISS file, as measured."
    build_seconds: float
    "As expected at all rows."
    sample_rows: int


Chosen = tuple[PlanTrial, TrialPoint]
"A tried plan with one setting of its search."


def choose(trials: Sequence[PlanTrial], gallery: GallerySpec) -> Chosen:
    """The fastest plan that is expected to reach the recall within all limits; where none does, the
    one with the highest recall within them.

    Raises InputError, with the nearest figures, where no plan keeps the limits.
    """
    allowed = [(trial, point) for trial in trials for point in _allowed_points(trial, gallery)]
    if not allowed:
        raise InputError(_nothing_allowed(trials, gallery))
    reaching = [pair for pair in allowed if pair[1].recall >= gallery.target_recall]
    if reaching:
        return max(reaching, key=lambda pair: pair[1].queries_per_second)
    return max(allowed, key=lambda pair: (pair[1].recall, pair[1].queries_per_second))


def reaches(trial: PlanTrial, gallery: GallerySpec) -> bool:
    """Whether a plan is expected to reach the recall within all limits."""
    points = _allowed_points(trial, gallery)
    return any(point.recall >= gallery.target_recall for point in points)


def rejection(trial: PlanTrial, gallery: GallerySpec, chosen: Chosen) -> str:
    """Why a tried plan was not taken, in words."""
    target = gallery.target_recall
    best = max(trial.points, key=lambda point: point.recall)
    if gallery.build_seconds is not None and trial.build_seconds > gallery.build_seconds:
        return f"would be built in {trial.build_seconds:,.0f} s, {gallery.build_seconds:,.0f} given"
    if best.recall < target:
        measured = f"{best.sample_recall:.3f} on {trial.sample_rows:,} rows"
        return f"recall@10 {best.recall:.3f} at most ({measured}), below {target}"
    point = next(point for point in trial.points if point.recall >= target)
    if gallery.p99_ms is not None and point.p99_ms > gallery.p99_ms:
        return f"p99 {point.p99_ms:.2f} ms at recall@10 {point.recall:.3f}, {gallery.p99_ms} given"
    rate, other = point.queries_per_second, chosen[1].queries_per_second
    return f"slower: {rate:,.0f} queries/s at recall@10 {point.recall:.3f} against {other:,.0f}"


def pareto_front(trials: Iterable[PlanTrial]) -> list[Chosen]:
    """The tried settings that no other one beats in recall, queries/s, p99, bytes a row and seconds
    to build, the highest recall first.
    """
    pairs = [(trial, point) for trial in trials for point in trial.points]
    front = [pair for pair in pairs if not any(_dominates(other, pair) for other in pairs)]
    return sorted(front, key=lambda pair: (-pair[1].recall, -pair[1].queries_per_second))


def plan_label(plan: IndexPlan) -> str:
    """A plan's factory, with what FAISS's string does not have."""
    on_disk = " on disk" if plan.on_disk else ""
    return plan.factory + (" + table" if plan.refine == "table" else "") + on_disk


def figures(pair: Chosen) -> dict[str, Any]:
    """A tried setting as `index.json` has it."""
    trial, point = pair
    return {
        "plan": plan_label(trial.plan),
        "nprobe_or_ef": point.nprobe_or_ef,
        "rerank_factor": point.rerank_factor,
        "list_ratio": point.list_ratio,
        "recall_at_10": round(point.recall, 4),
        "sample_recall_at_10": round(point.sample_recall, 4),
        "queries_per_second": round(point.queries_per_second, 1),
        "p99_ms": round(point.p99_ms, 3),
        "bytes_per_row": round(trial.bytes_per_row, 1),
        "build_seconds": round(trial.build_seconds, 1),
    }


def _allowed_points(trial: PlanTrial, gallery: GallerySpec) -> list[TrialPoint]:
    """The settings within the limits of memory, of time to build, and of latency."""
    if trial.plan.bytes > gallery.budget:
        return []
    if gallery.build_seconds is not None and trial.build_seconds > gallery.build_seconds:
        return []
    limit = gallery.p99_ms
    return [point for point in trial.points if limit is None or point.p99_ms <= limit]


def _nothing_allowed(trials: Sequence[PlanTrial], gallery: GallerySpec) -> str:
    """The sentence of limits that no plan keeps: the nearest of each."""
    seconds, limit = gallery.build_seconds, gallery.p99_ms
    soonest = min(trials, key=lambda trial: trial.build_seconds)
    if seconds is not None and soonest.build_seconds > seconds:
        return (
            f"--build-minutes allows {seconds:,.0f} s, and the index that is built soonest, "
            f"{plan_label(soonest.plan)}, is expected to take {soonest.build_seconds:,.0f} s; "
            "raise it"
        )
    points = [(trial, point) for trial in trials for point in trial.points]
    trial, point = min(points, key=lambda pair: pair[1].p99_ms)
    return (
        f"--p99-ms is {limit}, and the fastest search, by {plan_label(trial.plan)}, is expected to "
        f"take {point.p99_ms:.2f} ms for a batch of {gallery.batch} at recall@10 "
        f"{point.recall:.3f}; raise --p99-ms, --build-minutes or --memory-budget, or lower --batch"
    )


def _dominates(one: Chosen, other: Chosen) -> bool:
    """Whether one setting is at least as good in all and better in something."""
    a, b = _qualities(one), _qualities(other)
    return a != b and all(x >= y for x, y in zip(a, b, strict=True))


def _qualities(pair: Chosen) -> tuple[float, ...]:
    """The more, the better."""
    trial, point = pair
    speed = (point.queries_per_second, -point.p99_ms)
    return (point.recall, *speed, -trial.bytes_per_row, -trial.build_seconds)
