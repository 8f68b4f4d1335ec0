"""Figures for a paper: an evaluation in, PNG and PDF files out.

Drawn by matplotlib without its global state. Fonts are embedded as TrueType (type 42), which publishers ask for, files hold
no date, and the same evaluation gives the same bytes.
"""

import io
from collections.abc import Callable
from functools import partial
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from pipeline import figure_charts, storage
from pipeline.figure_panels import pairs_figure, panels_figure
from pipeline.part_measures import part_label
from pipeline.report_choice import choose
from pipeline.report_inputs import Extras, Findings, Format, Pictures
from pipeline.report_map import error_map
from pipeline.report_tasks import task_view

ROWS = 3  # hits, misses and places of a figure with pictures: what fits a page beside its caption
DPI = 300  # of PNG, and of pictures in PDF
STYLE: Any = {
    "font.family": "DejaVu Sans", "font.size": 7, "axes.titlesize": 7.5, "axes.linewidth": 0.6, "axes.spines.top": False,
    "axes.spines.right": False, "lines.linewidth": 1.2, "legend.frameon": False, "pdf.fonttype": 42, "savefig.dpi": DPI,
    "axes.grid": True, "grid.linewidth": 0.4, "grid.color": "#dddddd", "axes.axisbelow": True,
}  # fmt: skip
NO_DATES = {"png": {"Software": None}, "pdf": {"CreationDate": None}}


def write_figures(findings: Findings, pictures: Pictures, folder: str, formats: tuple[Format, ...]) -> list[str]:
    """Write every figure that the evaluation has data for into `folder`; returns their names without endings.

    Without pictures at hand there are no figures of hits and misses.
    """
    tasks = [task_view(row, findings.results_of(row), Extras(title="")) for row in findings.metrics]
    single = [task for task in tasks if not task.row["multi_query"]]
    makers: dict[str, Callable[[], Figure]] = {"recall": partial(figure_charts.recall_figure, tasks)}
    if single:
        makers["scores"] = partial(figure_charts.scores_figure, single)
    if findings.views:
        makers["views"] = partial(figure_charts.views_figure, findings.views)
    if findings.parts:
        makers["parts"] = partial(figure_charts.whiskers_figure, single, findings.parts, "part", part_label)
    for column in dict.fromkeys(row["by"] for row in findings.groups):
        rows = [row for row in findings.groups if row["by"] == column]
        makers[f"groups-{column}"] = partial(
            figure_charts.whiskers_figure, single, rows, column.replace("_", " "), figure_charts.group_label
        )
    for gap in findings.gaps:
        makers[f"view-gap-{gap['task'].replace('->', '-')}"] = partial(figure_charts.gap_figure, gap)
    for task in single:
        if drawn := error_map(task.name, task.rows):
            makers[f"map-{task.anchor}"] = partial(figure_charts.map_figure, drawn)
    choices = choose(tasks, ROWS)
    images = pictures(sorted(set[str]().union(*(choice.keys for choice in choices))))
    for choice in choices if images else ():
        name = choice.task.anchor
        makers[f"retrieval-{name}"] = partial(panels_figure, choice, images)
        if choice.pairs.shown:
            makers[f"multi-query-{name}"] = partial(pairs_figure, choice, images)
    for name, make in makers.items():
        for kind in formats:
            with matplotlib.rc_context(STYLE):  # drawn anew for each format: drawing moves what the layout has placed
                storage.write_bytes(storage.join(folder, f"{name}.{kind}"), _saved(make(), kind))
    return list(makers)


def _saved(figure: Figure, kind: Format) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format=kind, bbox_inches="tight", pad_inches=0.03, metadata=NO_DATES[kind])
    return stream.getvalue()
