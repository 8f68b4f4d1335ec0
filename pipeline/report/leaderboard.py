"""The leaderboard's page: rows of many methods in; one self-contained HTML page out.

Like the report it runs no script and loads nothing. Its pictures are those of the paper's figures 3
and 4 (hits and misses; one image beside all of its place) for the best method, and the gap between
the views by method.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.images.thumbnails import ImageLoader, ThumbnailCache, no_images
from pipeline.report import svg
from pipeline.report.charts import scatter
from pipeline.report.inputs import EvaluationResults, ReportContext
from pipeline.report.page import panel_section, report_environment
from pipeline.report.tasks import choose_panels, task_views

SHOWN_PANELS = 3
"Hits, misses and places of each direction."
DRONE_TO_SATELLITE = "drone->satellite"
"The task whose gap between the views is shown."


def render_leaderboard(
    rows: Sequence[Mapping[str, Any]],
    published: Sequence[Mapping[str, Any]],
    data: str,
    terms: str,
    evaluations: Mapping[str, EvaluationResults] | None = None,
    images: ImageLoader = no_images,
) -> str:
    """Render rows of `LeaderboardRow.as_dict` and of `PublishedResult`, best first.

    `data` and `terms` say in words what was trained on and at what cost. `evaluations`: one of each
    method, whose queries are shown with the pictures of `images`.
    """
    ordered = sorted(rows, key=lambda row: -row["tasks"][0]["r1"])
    lows = [task["low"] for row in rows for task in row["tasks"][:1]]
    highs = [task["high"] for row in rows for task in row["tasks"][:1]]
    start, end = min(lows), max(highs)
    baseline, best = rows[0]["method"], ordered[0]["method"]
    known = evaluations or {}
    environment = report_environment(
        percent=lambda value: f"{100 * value:.1f}",
        points=lambda value: f"{100 * value:+.1f}",
        along=lambda value: f"{100 * (value - start) / max(end - start, 1e-9):.1f}",
    )
    return environment.get_template("leaderboard.html").render(
        rows=ordered,
        baseline=baseline,
        best=best,
        published=sorted(published, key=lambda row: -row["drone_to_satellite"][0]),
        data=data,
        terms=terms,
        span=(start, end),
        sections=_sections(known[best], images) if best in known else [],
        gaps={row["method"]: gap for row in ordered for gap in _gaps(known, row["method"])},
        scatters=[
            (method, svg.layout_scatter(scatter(gap)))
            for method in dict.fromkeys((best, baseline))
            for gap in _gaps(known, method)
        ],
        geometry=svg,
    )


def _sections(results: EvaluationResults, images: ImageLoader) -> list[dict[str, Any]]:
    """The panels of each direction, as the template takes them."""
    choices = choose_panels(task_views(results, ReportContext(title="")), SHOWN_PANELS)
    thumbnails = ThumbnailCache(images(sorted(set[str]().union(*(one.keys for one in choices)))))
    return [panel_section(choice, thumbnails, {}, 1) for choice in choices]


def _gaps(evaluations: Mapping[str, EvaluationResults], method: str) -> list[dict[str, Any]]:
    """The gap between the two views, where the method's evaluation has measured it."""
    gaps = evaluations[method].gaps if method in evaluations else ()
    return [gap for gap in gaps if gap["task"] == DRONE_TO_SATELLITE]
