"""The report: an evaluation -> one self-contained HTML page.

In: an evaluation, its context, and loaders of images and embeddings by key. Out: the page as text:
measures, curves, hits and misses with their pictures; the same input gives the same page. The page
runs no script and loads nothing (no font, no request: its Content-Security-Policy forbids them),
and every name on it is escaped, since location names come from folder names.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment

from pipeline.core.arrays import Floats
from pipeline.core.templates import template_environment
from pipeline.images.thumbnails import ImageLoader, ThumbnailCache
from pipeline.report import map_sheet, svg
from pipeline.report.charts import scatter
from pipeline.report.inputs import EvaluationResults, ReportContext, VectorLoader, no_vectors
from pipeline.report.options import DEFAULT_PANELS
from pipeline.report.panels import make_panel
from pipeline.report.tables import group_tables, part_tables
from pipeline.report.tasks import (
    METRE_LABELS,
    METRIC_LABELS,
    PanelChoice,
    choose_panels,
    task_views,
)
from pipeline.report.training_charts import training_charts
from pipeline.retrieval.subsets import evenly_spaced

PROTOCOL_TEXTS = {
    "full": "the official protocol: the whole gallery is ranked, with its distractors",
    "queried-only": "the reduced protocol: gallery images of places that are not queried are left "
    "out, so its figures do not compare with those of the official one",
}
OPEN_PANELS = 6  # of a kind, spread over all of them; the others unfold on a click


def render_report(
    results: EvaluationResults,
    context: ReportContext,
    images: ImageLoader,
    vectors: VectorLoader = no_vectors,
    panels: int = DEFAULT_PANELS,
) -> str:
    """Render the page, with at most `panels` hits, misses and multi-query pairs of each task.

    Raises InputError if the evaluation beside ranked other images.
    """
    tasks = task_views(results, context)
    single = [task for task in tasks if not task.merged]
    names = {task.row["task"]: task.name for task in single}
    r1 = {task.row["task"]: task.row["r1"] for task in single}
    evidence = [
        *(task.views for task in single),
        *(task.scores for task in single),
        *(task.distances for task in single),
    ]
    choices = choose_panels(tasks, panels)
    keys = sorted(set[str]().union(*(choice.keys for choice in choices)))
    parts = {row["task"]: row["parts"] for row in results.parts}
    thumbnails, known = ThumbnailCache(images(keys)), vectors(keys) if parts else {}
    return (
        report_environment()
        .get_template("report.html")
        .render(
            title=context.title,
            fingerprint=results.metrics[0]["fingerprint"],
            protocol=PROTOCOL_TEXTS[results.metrics[0]["protocol"]],
            measures=METRIC_LABELS,
            tasks=tasks,
            beside=context.beside.name if context.beside else None,
            evidence=[chart for chart in evidence if chart],
            groups=group_tables(results.groups, names, r1),
            parts=part_tables(results.parts, names, r1),
            gaps=[svg.layout_scatter(scatter(gap, context.beside)) for gap in results.gaps],
            metres=METRE_LABELS if any(task.geo for task in tasks) else {},
            maps=[task.errors for task in single if task.errors],
            training=training_charts(context.training),
            sections=[
                panel_section(choice, thumbnails, known, parts.get(choice.task.row["task"], 1))
                for choice in choices
            ],
            geometry=svg,
            map_size=map_sheet,
        )
    )


def report_environment(**own: Callable[..., Any]) -> Environment:
    """The environment of this room's templates and macros; filters of one's own come last."""
    environment = template_environment(Path(__file__).parent / "templates")
    filters: dict[str, Callable[..., Any]] = {
        "percent": lambda value: f"{100 * value:.2f}",
        "points": lambda value: f"{100 * value:+.2f}",
        "metres": map_sheet.format_metres,
        "svg": svg.layout_chart,
        "opened": lambda items: _numbered(items, opened=True),
        "folded": lambda items: _numbered(items, opened=False),
    }
    environment.filters |= filters | own
    return environment


def _numbered(items: Sequence[Any], opened: bool) -> list[tuple[int, Any]]:
    """The panels that are open from the start, or the others, with their numbers from 1."""
    shown = set(evenly_spaced(len(items), OPEN_PANELS).tolist())
    return [(i + 1, item) for i, item in enumerate(items) if (i in shown) == opened]


def panel_section(
    choice: PanelChoice, thumbnails: ThumbnailCache, known: Mapping[str, Floats], parts: int
) -> dict[str, Any]:
    """The panels of one task, as the template takes them."""
    hits, misses = (
        [make_panel(row, thumbnails, known, parts) for row in rows]
        for rows in (choice.hits, choice.misses)
    )
    pairs = [
        (
            make_panel(pair.single, thumbnails),
            make_panel(pair.merged, thumbnails, merged=pair.images),
        )
        for pair in choice.pairs.shown
    ]
    return {
        "task": choice.task,
        "pictures": bool(thumbnails),
        "parts": parts,
        "hits": hits,
        "misses": misses,
        "pairs": pairs,
        "merged": choice.pairs,
    }
