"""Results -> one self-contained HTML page: measures, curves, and hits and misses with their
pictures.

In: an evaluation, what is shown beside it, and a way to fetch pictures by key. Out: the page as
text; the same input gives the same page. Nothing on it runs or leaves it: no script, no font, no
request (its Content-Security-Policy says so), and every name in it is escaped, as location names
are whatever a folder was called.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.core.templates import template_environment
from pipeline.features.table import Floats
from pipeline.images.thumbnails import ImageLoader, ThumbnailCache
from pipeline.report import charts, map_sheet, svg
from pipeline.report.charts import scatter, scores_chart, views_chart
from pipeline.report.error_map import distance_chart, error_map
from pipeline.report.inputs import EvaluationResults, ReportContext, VectorLoader, no_vectors
from pipeline.report.options import DEFAULT_PANELS
from pipeline.report.panels import make_panel
from pipeline.report.tables import group_tables, part_tables
from pipeline.report.tasks import METRIC_LABELS, PanelChoice, choose_panels, task_view
from pipeline.retrieval.subsets import evenly_spaced

PROTOCOL_TEXTS = {
    "full": "the official protocol: the whole gallery is ranked, with its distractors",
    "queried-only": "the reduced protocol: gallery images of places that are not queried are left out, so its figures do "
    "not compare with those of the official one",
}
OPEN_PANELS = (
    6  # panels of a kind that are open from the start, spread over all of them; the others unfold
)


def render_report(
    findings: EvaluationResults,
    extras: ReportContext,
    pictures: ImageLoader,
    vectors: VectorLoader = no_vectors,
    panels: int = DEFAULT_PANELS,
) -> str:
    """The page, with at most `panels` hits and as many misses of each task, and as many places
    asked for in both ways.

    Raises InputError when the evaluation beside ranked other images.
    """
    environment = template_environment(Path(__file__).parent / "templates")
    environment.filters |= {
        "percent": lambda value: f"{100 * value:.2f}",
        "points": lambda value: f"{100 * value:+.2f}",
        "metres": map_sheet.format_metres,
        "opened": lambda items: [(i + 1, items[i]) for i in evenly_spaced(len(items), OPEN_PANELS)],
        "folded": lambda items: [
            (i + 1, items[i])
            for i in range(len(items))
            if i not in evenly_spaced(len(items), OPEN_PANELS)
        ],
    }
    tasks = [task_view(row, findings.results_of(row), extras) for row in findings.metrics]
    single = [task for task in tasks if not task.row["multi_query"]]
    names = {task.row["task"]: task.name for task in single}
    r1 = {task.row["task"]: task.row["r1"] for task in single}
    evidence = [
        *(
            views_chart(
                f"{task.name}, R@1 by views a query",
                [row for row in findings.views if row["task"] == task.row["task"]],
            )
            for task in single
        ),
        *(scores_chart(f"{task.name}, scores", task.rows) for task in single),
        *(distance_chart(f"{task.name}, distance", task.rows) for task in single),
    ]
    choices = choose_panels(tasks, panels)
    keys = sorted(set[str]().union(*(choice.keys for choice in choices)))
    parts = {row["task"]: row["parts"] for row in findings.parts}
    album, known = ThumbnailCache(pictures(keys)), vectors(keys) if parts else {}
    maps = [error_map(task.name, task.rows) for task in single]
    return environment.get_template("report.html").render(
        title=extras.title,
        fingerprint=findings.metrics[0]["fingerprint"],
        protocol=PROTOCOL_TEXTS[findings.metrics[0]["protocol"]],
        measures=METRIC_LABELS,
        tasks=tasks,
        beside=extras.beside.name if extras.beside else None,
        evidence=[chart for chart in evidence if chart],
        groups=group_tables(findings.groups, names, r1),
        parts=part_tables(findings.parts, names, r1),
        gaps=[scatter(gap, extras.beside) for gap in findings.gaps],
        maps=[each for each in maps if each],
        training=svg.training_charts(extras.training),
        sections=[
            _section(choice, album, known, parts.get(choice.task.row["task"], 1))
            for choice in choices
        ],
        charts=svg,
        scatters=charts,
        map_size=map_sheet,
    )


def _section(
    choice: PanelChoice, album: ThumbnailCache, known: Mapping[str, Floats], parts: int
) -> dict[str, Any]:
    """A task's panels."""
    hits, misses = (
        [make_panel(row, album, known, parts) for row in rows]
        for rows in (choice.hits, choice.misses)
    )
    pairs = [
        (make_panel(pair.single, album), make_panel(pair.merged, album, merged=pair.images))
        for pair in choice.pairs.shown
    ]
    return {
        "task": choice.task,
        "pictures": bool(album),
        "parts": parts,
        "hits": hits,
        "misses": misses,
        "pairs": pairs,
        "merged": choice.pairs,
    }
